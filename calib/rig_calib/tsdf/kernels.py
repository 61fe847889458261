"""Loops of the volume, compiled: which blocks a range image touches, and what it says of their voxels.

All sums are of integers: whatever the order in which images, threads and workers add to them, they are the
same to the last bit.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_calib.fusion.voxels import KEY_BITS
from rig_protocol.compiled import compiled, inlined

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
I32 = npt.NDArray[np.int32]

SIDE = 8
"""Voxels along a block's edge."""

VOXELS = SIDE**3
UNITS_A_METRE = 1e5
"""Of a distance in the sums: 10 µm, below any noise."""

# Weights are 1/σ² in whole numbers: 1 for 128 mm, as far and slanting as a Kinect ever measures. Below 1 mm
# it is what calibration leaves that limits a measurement, not its noise.
_UNIT_SIGMA_M, _LEAST_SIGMA_M = 0.128, 1e-3
_COLOR_SHIFT = 7  # colours need no more than 7 bits of weight
_BAND_SIGMAS, _BAND_VOXELS = 3.0, 2.0
STRIDE_PX = 2  # of the pixels around which blocks are laid: closer together than blocks are wide
_HALF_BLOCKS = 1 << (KEY_BITS - 1)


class Camera(NamedTuple):
    """A range image as the loops take it: `lens` is fx, fy, cx, cy, k1, k2, p1, p2, k3."""

    T_grid_rig: F64  # (3,4)
    lens: F64  # (9,)
    widest: float  # squared tangent of the corners: beyond it a lens polynomial means nothing
    inverse_depth: F32  # (H,W)
    incidence: F32  # (H,W)
    colors: npt.NDArray[np.uint8]  # (H,W,3)
    colored: npt.NDArray[np.bool_]  # (H,W)
    sigma_1m: float
    frames: int


class Sums(NamedTuple):
    """What was said of the voxels of B blocks: Σ w·d, Σ w, Σ v·colour and Σ v."""

    distance: I64  # (B,512)
    weight: I32  # (B,512)
    color: I32  # (B,512,3)
    color_weight: I32  # (B,512)


@inlined
def truncation_m(sigma_1m: float, depth_m: float, voxel_m: float) -> float:
    """Beyond three σ nothing of a surface is seen; two voxels hold the corners of every cube it crosses."""
    return _BAND_SIGMAS * sigma_1m * depth_m * depth_m + _BAND_VOXELS * voxel_m


@compiled()
def list_blocks(
    inverse_depth: F32, rays: F64, origin: F64, sigma_1m: float, voxel_m: float, steps: int, keys: I64
) -> int:
    """Write the keys of blocks within the truncation of what was measured, often twice; how many.

    `rays` (H,W,3), of z = 1 in the grid's frame, are turned to the rig's, as is `origin` (3,). `steps` points
    on each are looked at, each widened by two voxels.
    """
    count, block_m, reach_m = 0, SIDE * voxel_m, _BAND_VOXELS * voxel_m
    height, width = inverse_depth.shape
    for y in range(0, height, STRIDE_PX):
        for step in range(steps):
            share = 2.0 * step / (steps - 1) - 1.0
            for corner in range(8):
                x0 = origin[0] + (reach_m if corner & 1 else -reach_m)
                y0 = origin[1] + (reach_m if corner & 2 else -reach_m)
                z0 = origin[2] + (reach_m if corner & 4 else -reach_m)
                last = np.int64(-1)
                for x in range(0, width, STRIDE_PX):
                    if inverse_depth[y, x] <= 0.0:
                        continue
                    depth = 1.0 / inverse_depth[y, x]
                    depth += share * truncation_m(sigma_1m, depth, voxel_m)
                    i = _cell(x0 + rays[y, x, 0] * depth, block_m)
                    j = _cell(y0 + rays[y, x, 1] * depth, block_m)
                    k = _cell(z0 + rays[y, x, 2] * depth, block_m)
                    key = i << (2 * KEY_BITS) | j << KEY_BITS | k  # as voxel_keys has it
                    if key != last:
                        keys[count] = key
                        count += 1
                        last = key
    return count


@inlined
def _cell(place_m: float, block_m: float) -> np.int64:
    return np.int64(np.floor(place_m / block_m)) + np.int64(_HALF_BLOCKS)


@compiled()
def integrate(first: int, last: int, corners: I64, voxel_m: float, camera: Camera, sums: Sums) -> None:
    """Add what a range image says of blocks `first` to `last`; their lowest voxels are `corners` (B,3)."""
    T, widest = camera.T_grid_rig, np.sqrt(camera.widest)
    half_m = 0.5 * (SIDE - 1) * voxel_m
    radius_m = np.sqrt(3.0) * half_m
    for block in range(first, last):
        x0, y0, z0 = corners[block, 0] * voxel_m, corners[block, 1] * voxel_m, corners[block, 2] * voxel_m
        x, y, z = _moved(T, x0 + half_m, y0 + half_m, z0 + half_m)
        # Outside the cone around the image's corners: no voxel of it can be seen.
        if z < -radius_m or np.hypot(x, y) > widest * z + radius_m * np.sqrt(1.0 + camera.widest):
            continue
        for voxel in range(VOXELS):
            i, j, k = voxel // (SIDE * SIDE), voxel // SIDE % SIDE, voxel % SIDE
            x, y, z = _moved(T, x0 + i * voxel_m, y0 + j * voxel_m, z0 + k * voxel_m)
            if z > 0.0 and x * x + y * y < camera.widest * z * z:
                _add(block, voxel, x / z, y / z, z, voxel_m, camera, sums)


@inlined
def _moved(T: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@inlined
def _add(
    block: int, voxel: int, x: float, y: float, z: float, voxel_m: float, camera: Camera, sums: Sums
) -> None:
    """Add what the pixel says that shows a voxel at tangents x, y and depth z.

    The distance is that from the surface's plane, positive before it. A voxel behind the surface by more
    than the truncation is hidden: nothing is said of it. One before it by more is free space, at the
    weight that a surface right there would have: whoever sees through a place is believed as much about
    it as who sees something there.
    """
    u, v = _pixel(camera.lens, x, y)
    left, top = int(np.floor(u)), int(np.floor(v))
    height, width = camera.inverse_depth.shape
    if left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
        return
    inverse_depth = _between(camera.inverse_depth, left, top, u - left, v - top)
    if inverse_depth <= 0.0:
        return
    column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    slant = float(camera.incidence[row, column])
    distance = (1.0 / inverse_depth - z) * np.sqrt(1.0 + x * x + y * y) * slant
    truncation = truncation_m(camera.sigma_1m, z, voxel_m)
    if distance < -truncation:
        return
    free = distance >= truncation
    if free:
        distance, slant = truncation, 1.0
    sigma = max(camera.sigma_1m * z * z, _LEAST_SIGMA_M) / slant
    weight = max(int(_UNIT_SIGMA_M**2 / (sigma * sigma) + 0.5), 1)
    sums.distance[block, voxel] += weight * camera.frames * int(np.floor(distance * UNITS_A_METRE + 0.5))
    sums.weight[block, voxel] += weight * camera.frames
    if not free and camera.colored[row, column]:
        weight = max(weight >> _COLOR_SHIFT, 1)
        sums.color_weight[block, voxel] += weight
        for channel in range(3):
            sums.color[block, voxel, channel] += weight * camera.colors[row, column, channel]


@inlined
def _pixel(lens: F64, x: float, y: float) -> tuple[float, float]:
    """OpenCV's projection of tangents."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return fx * u + cx, fy * v + cy


@inlined
def _between(inverse_depth: F32, left: int, top: int, right_share: float, low_share: float) -> float:
    """Interpolated 1/z, in which planes are straight; beside holes that of the nearest pixel, 0 for none."""
    a, b = float(inverse_depth[top, left]), float(inverse_depth[top, left + 1])
    c, d = float(inverse_depth[top + 1, left]), float(inverse_depth[top + 1, left + 1])
    if a <= 0.0 or b <= 0.0 or c <= 0.0 or d <= 0.0:
        upper, lower = (a, c) if right_share < 0.5 else (b, d)
        return upper if low_share < 0.5 else lower
    upper, lower = a + right_share * (b - a), c + right_share * (d - c)
    return upper + low_share * (lower - upper)
