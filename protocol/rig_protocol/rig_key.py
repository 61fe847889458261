"""The rig's key: one secret that every agent and the server hold; who has it belongs to the rig."""

import base64
import binascii
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from rig_protocol.errors import DataError

KEY_SIZE = 32
_LABEL = "kinect-rig-key-1"  # opens a key file's line: format 1


@dataclass(frozen=True, slots=True)
class RigKey:
    """32 secret bytes; never shown by `repr`, so that no log can hold them."""

    secret: bytes = field(repr=False)

    INSECURE: ClassVar["RigKey"]
    """The key of `--insecure`: public, so that anybody may join. It keeps out nobody but accidents."""

    def __post_init__(self) -> None:
        if len(self.secret) != KEY_SIZE:
            raise ValueError(f"a rig key has {KEY_SIZE} bytes, not {len(self.secret)}")

    @classmethod
    def generate(cls, random_bytes: Callable[[int], bytes]) -> "RigKey":
        """A fresh key from an unguessable source, for example `secrets.token_bytes`."""
        return cls(random_bytes(KEY_SIZE))

    @classmethod
    def parse(cls, text: str) -> "RigKey":
        """The key of a key file's text; DataError when it holds none."""
        words = text.split()
        if len(words) != 2 or words[0] != _LABEL:
            raise DataError(f"no line `{_LABEL} ...`: make a key file with `rig-server keygen`")
        try:
            return cls(base64.b64decode(words[1], validate=True))
        except (binascii.Error, ValueError) as error:
            raise DataError("the key is damaged: copy the file again from the server") from error

    def to_text(self) -> str:
        """What a key file holds."""
        return f"{_LABEL} {base64.b64encode(self.secret).decode()}\n"

    @property
    def is_public(self) -> bool:
        """True for the key of `--insecure`."""
        return self == RigKey.INSECURE


RigKey.INSECURE = RigKey(b"kinect-rig: anybody may join it!")
