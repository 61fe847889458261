"""What a page is made of: embedded images with their descriptions."""

import base64
from dataclasses import dataclass

from rig_calib.figures.pictures import encode_jpeg, encode_png
from rig_protocol.frames import ImageU8


@dataclass(frozen=True, slots=True)
class Figure:
    """An embedded image with its caption, and its description for those who cannot see it."""

    data_uri: str
    alt: str
    caption: str = ""

    @classmethod
    def photo(cls, image: ImageU8, alt: str, caption: str = "") -> "Figure":
        """An image (H,W,3), BGR, as JPEG."""
        return cls._embed("jpeg", encode_jpeg(image), alt, caption)

    @classmethod
    def drawing(cls, image: ImageU8, alt: str, caption: str = "") -> "Figure":
        """An image (H,W,3), BGR, of few colours, as PNG."""
        return cls._embed("png", encode_png(image), alt, caption)

    @classmethod
    def _embed(cls, kind: str, data: bytes, alt: str, caption: str) -> "Figure":
        return cls(f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}", alt, caption)
