"""Frames encoded once, kept in a file, played many times: load for benchmarks that leave the encoder out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rig_protocol.codecs import Codec, codec_by_name
from rig_protocol.frames import NO_DISPARITY, EncodedFrame, ImageU8, ImageU16, Payload
from support.images import mosaic, read_image

Format = Literal["lossless", "rgb24"]
"""Bayer and disparity without loss; or as the paper sends: 24-bit colour and 16-bit depth, uncompressed."""

ImagePair = tuple[ImageU8, ImageU16]

_CODECS: dict[Format, tuple[str, str]] = {
    "lossless": ("bayer-lossless", "disparity-lossless"),
    "rgb24": ("bgr-uncompressed", "disparity-uncompressed"),
}
_PAIRS = 12
# Noise with which a synthetic image packs to the size of a recorded one; a test compares them.
_COLOR_SIGMA, _DISPARITY_SIGMA = 3.6, 0.2


@dataclass(frozen=True)
class PreencodedFrames:
    """Pairs of payloads (colour, depth) and their codecs; `real` when a sensor saw them."""

    form: Format
    color_codec: int
    depth_codec: int
    pairs: tuple[tuple[bytes, bytes], ...]
    real: bool

    @property
    def frame_bytes(self) -> float:
        """Mean payload of a frame."""
        return sum(len(color) + len(depth) for color, depth in self.pairs) / len(self.pairs)

    @property
    def origin(self) -> str:
        """Where the images come from, for a result."""
        return "recorded Kinect images" if self.real else "synthetic images of the same packed size"

    def frame(self, camera_id: int, sequence: int, timestamp_ns: int) -> EncodedFrame:
        """One frame of a camera; successive frames, and cameras at the same time, show different images."""
        color, depth = self.pairs[(camera_id + sequence) % len(self.pairs)]
        return EncodedFrame(
            camera_id,
            sequence,
            timestamp_ns,
            color=Payload(self.color_codec, color),
            depth=Payload(self.depth_codec, depth),
        )

    def save(self, file: Path) -> None:
        """Into a file for `load`."""
        arrays = {
            f"{name}_{k}": np.frombuffer(data, np.uint8)
            for k, pair in enumerate(self.pairs)
            for name, data in zip(("color", "depth"), pair, strict=True)
        }
        facts = np.array([self.color_codec, self.depth_codec, len(self.pairs), self.real])
        with file.open("wb") as out:
            np.savez(out, form=np.array(self.form), facts=facts, **arrays)

    @classmethod
    def load(cls, file: Path) -> "PreencodedFrames":
        """What `save` wrote."""
        with np.load(file) as arrays:
            color_codec, depth_codec, count, real = map(int, arrays["facts"])
            form: Format = "rgb24" if str(arrays["form"]) == "rgb24" else "lossless"
            pairs = tuple(
                (arrays[f"color_{k}"].tobytes(), arrays[f"depth_{k}"].tobytes()) for k in range(count)
            )
        return cls(form, color_codec, depth_codec, pairs, bool(real))


def encode_frames(form: Format) -> PreencodedFrames:
    """The shared recorded images in this format; synthetic ones where those are absent."""
    images, real = _images()
    color, depth = (codec_by_name(name) for name in _CODECS[form])
    pairs = tuple((_encode_color(color, bgr), depth.encode(raw)) for bgr, raw in images)
    return PreencodedFrames(form, color.id, depth.id, pairs, real)


def recorded_images() -> list[ImagePair]:
    """BGR and disparity of the shared data; a pytest skip where it is absent."""
    from support.real_data import real_data  # imports pytest, which no sender needs

    colors = sorted(real_data("tum_fr1_rpy_12views").glob("cam*/color_*.png"))
    raws = sorted(real_data("kinect_v1_raw").glob("raw_*.png"))
    pairs = zip(colors[:_PAIRS], raws[:_PAIRS], strict=True)
    return [(np.asarray(read_image(c), np.uint8), np.asarray(read_image(r), np.uint16)) for c, r in pairs]


def synthetic_images() -> list[ImagePair]:
    """BGR and disparity with as much to pack as the recorded ones."""
    return [
        (_surface(60, _COLOR_SIGMA, seed).astype(np.uint8), _disparity(seed)) for seed in range(1, _PAIRS + 1)
    ]


def _images() -> tuple[list[ImagePair], bool]:
    import pytest

    try:
        return recorded_images(), True
    except pytest.skip.Exception:
        return synthetic_images(), False


def _encode_color(codec: Codec, bgr: ImageU8) -> bytes:
    return codec.encode(mosaic(bgr) if codec.image == "bayer" else bgr)


def _disparity(seed: int) -> ImageU16:
    """A surface with holes, as a wall with shadows."""
    image = _surface(500, _DISPARITY_SIGMA, seed)[..., 0].astype(np.uint16)
    holes = np.random.default_rng(seed).random((60, 80)) < 0.3
    image[holes.repeat(8, 0).repeat(8, 1)] = NO_DISPARITY
    return image


def _surface(offset: float, sigma: float, seed: int) -> npt.NDArray[np.float64]:
    """Slopes and noise (480,640,3)."""
    y, x = np.mgrid[:480, :640]
    slopes = np.repeat((offset + 0.1 * x + 0.2 * y)[..., np.newaxis], 3, axis=2)
    return np.asarray((slopes + np.random.default_rng(seed).normal(0, sigma, slopes.shape)).round())
