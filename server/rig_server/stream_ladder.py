"""The levels that a rig steps down when its link is too small, and what each means for one camera.

First less for the same picture (uncompressed → lossless), then JPEG colour, then fewer frames. All
cameras stand on one level (docs/decisions/0008-one-level-for-all-cameras.md). Depth is always lossless.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, codec
from rig_protocol.message_bytes import MIN_FPS
from rig_protocol.messages import Hello
from rig_server.stream_sizes import expected_bytes


class Manner(IntEnum):
    """How images travel, the dearest first."""

    PREFERRED = 0  # as each agent likes best
    LOSSLESS = 1
    JPEG = 2  # colour


@dataclass(frozen=True, slots=True, order=True)
class Level:
    """A smaller one asks more of the link. Every `divisor`-th frame of the fastest camera is sent."""

    manner: Manner
    divisor: int


@dataclass(frozen=True, slots=True)
class Streams:
    """What one camera sends; a codec of None: the camera has no such stream."""

    color_codec: int | None
    depth_codec: int | None
    fps: float

    @property
    def codecs(self) -> tuple[int, ...]:
        """Those that there are."""
        return tuple(one for one in (self.color_codec, self.depth_codec) if one is not None)


# Whole divisors: an agent leaves frames out, it does not shift them.
_DIVISORS = (1, 2, 3, 4, 5, 6, 8, 10, 15, 30)
TOP = Level(Manner.PREFERRED, 1)


def ladder(allow_jpeg: bool) -> tuple[Level, ...]:
    """All levels, downwards."""
    manners = [manner for manner in Manner if allow_jpeg or manner is not Manner.JPEG]
    return (*(Level(manner, 1) for manner in manners), *(Level(manners[-1], k) for k in _DIVISORS[1:]))


def streams_at(hello: Hello, level: Level, top_fps: float) -> Streams:
    """What the camera of a hello sends on a level; `top_fps` is the rate of the rig's fastest camera.

    An agent that offers nothing smaller keeps what it prefers.
    """
    divisor = math.ceil(hello.fps * level.divisor / top_fps - 1e-6)
    return Streams(
        _pick(hello.color_codecs, COLOR_CODECS, level.manner),
        _pick(hello.depth_codecs, DEPTH_CODECS, level.manner),
        max(hello.fps / max(1, divisor), MIN_FPS),
    )


@lru_cache(maxsize=256)  # asked a thousand times a second; agents differ little
def _pick(offered: tuple[int, ...], accepted: tuple[int, ...], manner: Manner) -> int | None:
    """The smallest of the preferred codec and those that the manner allows."""
    known = [one for one in offered if one in accepted]
    allowed = known[:1] + [one for one in known[1:] if _allows(manner, one)]
    return min(allowed, key=lambda one: expected_bytes(one, 1), default=None)


def _allows(manner: Manner, codec_id: int) -> bool:
    return manner is Manner.JPEG or (manner is Manner.LOSSLESS and codec(codec_id).lossless)
