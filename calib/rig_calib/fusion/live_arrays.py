"""Arrays and numbers that the live fusion's compiled loops share.

Rows of scratch lie in one flat array, a constant pitch apart: the compiler then knows that they do not
overlap, and makes vector instructions of loops that read and write many of them.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import inlined

F32 = np.float32
Array32 = npt.NDArray[np.float32]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
U32 = npt.NDArray[np.uint32]
U64 = npt.NDArray[np.uint64]

BAYER, BGR, GREY = 0, 1, 2
EMPTY = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
"""A panorama cell on which nothing fell: farther than everything."""

MAX_WIDTH = 2000
"""Columns of a depth image, and rows of a panorama."""
PITCH = 2064
"""Elements from one row of scratch to the next; no multiple of a page, which would crowd the cache."""
MARGIN = 32
"""Room at both ends of a row of scratch."""

UNSEEN = np.int16(-(2**15))

ZERO, HALF, ONE, TWO = F32(0.0), F32(0.5), F32(1.0), F32(2.0)
UNITS_A_METRE = F32(1e5)
"""Of a distance in the windows."""

_INVERSE_STEP = F32(1 / 2**17)  # 1/m: 0.1 mm at 4 m, against 20 mm of noise
_WEIGHT_BITS = np.uint32(13)
_WEIGHT_MASK = np.uint32(2**13 - 1)
_WEIGHT_SHIFT = np.uint32(16)  # leaves a float's exponent and seven bits after the point: 0.4 %
_LEAST_WEIGHT = np.int32((127 - 40) << 7)  # 2^-40; 13 bits hold 64 powers of two
NOTHING = np.uint32(1 << 30)
"""A packed measurement without weight, at 1 m: what looks there divides by no zero."""


class Lens(NamedTuple):
    """A depth camera: disparity model, limits of q, pinhole, all f32 scalars."""

    numerator: F32
    offset: F32
    least: F32
    most: F32
    fx: F32
    fy: F32
    cx: F32
    cy: F32


class Scratch(NamedTuple):
    """What one thread needs while it works on one camera, or on a column of the panorama."""

    inverse: Array32  # (H,W)
    likely: Array32  # (H,W)
    solid: U8  # (H,W)
    eroded: U8  # (H,W)
    columns: I16  # (W,)
    rows: Array32  # (16·PITCH,)
    places: I32  # (4·PITCH,)
    quads: U32  # (h·w,) of the colour image


class Ring(NamedTuple):
    """Tables of all C cameras; poses (C,3,4) f32, intrinsics (C,9): fx, fy, cx, cy, k1, k2, p1, p2, k3.

    `scales`: corrected 1/z by q. `tables`: of every pixel its ray (a, b, 1) and its place in the colour
    image, (u, v) + (du, dv) / z; as what differs from a plane, so that memory, which limits the loops, has
    less to carry: value = c₀ + c₁ x + c₂ y + c₃ table, with `planes` (C,6,4) for c. `UNSEEN` as u: the colour
    camera cannot see it. `scans`: along a row in direction ±1 near things are ever farther behind in the
    colour image. `partners` (C,K): cameras that share a view, −1 for none; `spans`: columns from and to which
    partner k may see what a row sees.
    """

    scales: Array32  # (C,H,W)
    tables: I16  # (C,6,H,W)
    planes: Array32  # (C,6,4)
    scans: I64  # (C,)
    T_rig_grid: Array32  # (C,3,4)
    T_grid_rig: Array32  # (C,3,4)
    lenses: Array32  # (C,9)
    partners: I64  # (C,K)
    spans: I64  # (C,K,H,2)


class Drum(NamedTuple):
    """The cylinder as the kernels need it; `starts` (C,) and `cells` (C,W',H) are every camera's window.

    `T_window_rig` (C,3,4): z along the cylinder's axis, x towards the middle of the window.

    A window is kept column by column, as the cameras of a ring, which stand upright, draw it row by row.
    """

    T_window_rig: Array32  # (C,3,4)
    pixels_per_rad: F32
    slope_top: F32
    circle: int  # columns of a full circle
    starts: I64
    cells: U64


@inlined
def packed(inverse: F32, weight: F32) -> np.uint32:
    """1/z in 1/m, up to 4, and the weight of a measurement, 0 for none, in 32 bits."""
    steps = np.uint32(inverse / _INVERSE_STEP + HALF)
    code = np.int32(np.float32(weight).view(np.uint32) >> _WEIGHT_SHIFT) - _LEAST_WEIGHT
    return (steps << _WEIGHT_BITS) | np.uint32(min(max(code, np.int32(0)), np.int32(_WEIGHT_MASK)))


@inlined
def inverse_of(measured: np.uint32) -> F32:
    """1/z of a packed measurement."""
    return F32(np.int32(measured >> _WEIGHT_BITS)) * _INVERSE_STEP


@inlined
def weight_of(measured: np.uint32) -> F32:
    """Weight of a packed measurement."""
    code = np.int32(measured & _WEIGHT_MASK)
    weight = np.uint32((code + _LEAST_WEIGHT) << np.int32(_WEIGHT_SHIFT)).view(np.float32)
    return weight if code > np.int32(0) else ZERO
