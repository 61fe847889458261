"""Independent streams of random numbers: one for each thing that a seed decides."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """First word of the spawn key: what the numbers are for."""

    ROOM = 7001
    TEXTURE = 7002
    UNIT = 7003
    MOUNT = 7004
    FIXED_NOISE = 7005
    FRAME = 7006
    PHASE = 7007
    KNOCK = 7008
    PEOPLE = 7009
    ACCELEROMETER = 7010


def generator(seed: int, stream: Stream, *key: int) -> np.random.Generator:
    """The generator of one stream; equal arguments give equal numbers, whoever asks and when."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream, *key)))
