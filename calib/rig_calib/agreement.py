"""Which matches agree with which poses, compiled: the inner loop of RANSAC."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_calib.observation_kernels import distorted
from rig_protocol.compiled import compiled, inlined

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_MIN_DEPTH_M = 0.05


class Limits(NamedTuple):
    """A match agrees when pixels (squared distance) and inverse depths differ by no more than this."""

    pixels_squared: float
    inverse_depth: float
    depth_scale: float


@inlined
def _agrees(
    k: Array, x: float, y: float, z: float, u: float, v: float, z_there: float, limits: Limits
) -> bool:
    """Whether a point falls on a pixel and is as deep as that one's own point, NaN for none."""
    if not z > _MIN_DEPTH_M:
        return False
    x_distorted, y_distorted = distorted(k, 0, x / z, y / z)
    across = k[0, 0] * x_distorted + k[0, 2] - u
    down = k[0, 1] * y_distorted + k[0, 3] - v
    if not across**2 + down**2 < limits.pixels_squared:
        return False
    allowed = limits.inverse_depth + limits.depth_scale / z_there
    return not abs(1.0 / z - 1.0 / z_there) > allowed


@compiled()
def agreement(
    limits: Limits,
    poses: Array,
    camera_i: Array,
    pixels_i: Array,
    points_i: Array,
    camera_j: Array,
    pixels_j: Array,
    points_j: Array,
) -> Mask:
    """(B,N) whether poses T_i_j (B,4,4) explain N matches by every measurement they have.

    Cameras (1,9) are intrinsics as `Cameras` has them; points (N,3) are NaN without depth. A match that has
    depth on neither side agrees with nothing.
    """
    out = np.zeros((len(poses), len(pixels_i)), dtype=np.bool_)
    for b in range(len(poses)):
        for n in range(len(pixels_i)):
            x, y, z = points_j[n, 0], points_j[n, 1], points_j[n, 2]
            z_i, z_j = points_i[n, 2], z
            agrees = not (np.isnan(z_i) and np.isnan(z_j))
            if not np.isnan(z_j):
                X = poses[b, 0, 0] * x + poses[b, 0, 1] * y + poses[b, 0, 2] * z + poses[b, 0, 3]
                Y = poses[b, 1, 0] * x + poses[b, 1, 1] * y + poses[b, 1, 2] * z + poses[b, 1, 3]
                Z = poses[b, 2, 0] * x + poses[b, 2, 1] * y + poses[b, 2, 2] * z + poses[b, 2, 3]
                agrees = _agrees(camera_i, X, Y, Z, pixels_i[n, 0], pixels_i[n, 1], z_i, limits)
            if agrees and not np.isnan(z_i):
                x, y = points_i[n, 0] - poses[b, 0, 3], points_i[n, 1] - poses[b, 1, 3]
                z = z_i - poses[b, 2, 3]
                X = poses[b, 0, 0] * x + poses[b, 1, 0] * y + poses[b, 2, 0] * z
                Y = poses[b, 0, 1] * x + poses[b, 1, 1] * y + poses[b, 2, 1] * z
                Z = poses[b, 0, 2] * x + poses[b, 1, 2] * y + poses[b, 2, 2] * z
                agrees = _agrees(camera_j, X, Y, Z, pixels_j[n, 0], pixels_j[n, 1], z_j, limits)
            out[b, n] = agrees
    return out
