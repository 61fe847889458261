"""Volume: truncated signed distances in blocks of 8³ voxels near surfaces.

Method: Curless & Levoy, A Volumetric Method for Building Complex Models from Range Images, SIGGRAPH 1996, in
the sparse blocks of Nießner et al., Real-time 3D Reconstruction at Scale using Voxel Hashing, 2013.
"""

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from rig_calib.fusion.voxels import Keys, voxel_index
from rig_calib.parallel import in_threads
from rig_calib.projection import pixel_rays
from rig_calib.tsdf.kernels import (
    SIDE,
    STRIDE_PX,
    UNITS_A_METRE,
    VOXELS,
    Camera,
    Sums,
    integrate,
    list_blocks,
    truncation_m,
)
from rig_calib.tsdf.range_image import RangeImage
from rig_protocol.errors import ConfigurationError
from rig_protocol.poses import inverse

MIN_VOXEL_M, MAX_VOXEL_M = 2e-3, 0.1
MAX_BLOCKS = 100_000
"""1.4 GB of sums."""

MAX_FRAMES = 10_000
"""Of which the weights' sums cannot flow over, of up to 13 cameras at their nearest."""

_CHUNKS = 16  # a thread's work is cut into so many: blocks before a camera cost more than those beside it
_ROWS = 4096  # blocks whose doubles are held at a time


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """Sums over B blocks, `keys` (B,) ascending; voxel (i, j, k) is the rig frame's point (i, j, k)·voxel_m.

    Blocks must be there before images are added: an image says something of every voxel that it sees
    through, too.
    """

    voxel_m: float
    keys: Keys
    sums: Sums

    @classmethod
    def at(cls, keys: Keys, voxel_m: float) -> "Volume":
        """An empty volume; ConfigurationError for more blocks than MAX_BLOCKS."""
        check_size(len(keys), voxel_m)
        shape = len(keys), VOXELS
        sums = Sums(
            distance=np.zeros(shape, np.int64),
            weight=np.zeros(shape, np.int32),
            color=np.zeros((*shape, 3), np.int32),
            color_weight=np.zeros(shape, np.int32),
        )
        return cls(voxel_m, keys, sums)

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.keys)

    @property
    def corners(self) -> npt.NDArray[np.int64]:
        """The lowest voxel (B,3) of every block."""
        return np.asarray(voxel_index(self.keys) * SIDE)

    def add(self, images: Iterable[RangeImage], threads: int | None = None) -> None:
        """Add what the images say of every voxel; the result is the same for any order and threads."""
        corners, threads = self.corners, threads or os.cpu_count() or 1
        edges = np.linspace(0, len(self), threads * _CHUNKS + 1).astype(int).tolist()
        parts = list(pairwise(edges))
        for image in images:
            work = partial(self._add_to_part, corners, _camera(image))
            for _ in in_threads(work, parts, threads):
                pass

    def take(self, other: "Volume") -> None:
        """Add another volume's sums: then this one is that of all images of both.

        ValueError for another voxel, or a block that is not among these.
        """
        rows = np.minimum(np.searchsorted(self.keys, other.keys), max(len(self) - 1, 0))
        if other.voxel_m != self.voxel_m or not np.isin(other.keys, self.keys).all():
            raise ValueError("a volume takes what has its voxel and blocks")
        for field in Sums._fields:
            getattr(self.sums, field)[rows] += getattr(other.sums, field)

    def _add_to_part(self, corners: Keys, camera: Camera, part: tuple[int, int]) -> None:
        integrate(*part, corners, self.voxel_m, camera, self.sums)

    def distances_m(self) -> npt.NDArray[np.float32]:
        """Mean signed distances (B,512), positive before surfaces; NaN of which nothing is known."""
        mean = np.empty(self.sums.weight.shape, np.float32)
        for first in range(0, len(self), _ROWS):
            rows = slice(first, first + _ROWS)
            weight = self.sums.weight[rows]
            with np.errstate(invalid="ignore"):  # 0/0 is NaN
                mean[rows] = self.sums.distance[rows] / (weight * UNITS_A_METRE)
        return mean


def blocks_near(images: Sequence[RangeImage], voxel_m: float) -> Keys:
    """Keys (B,), ascending, of the blocks around what the images measured."""
    found = [_blocks_of(image, voxel_m) for image in images]
    return np.unique(np.concatenate(found)) if found else np.empty(0, np.int64)


def check_size(blocks: int, voxel_m: float) -> None:
    """ConfigurationError when that many blocks are too many, with the voxel that would do."""
    if blocks > MAX_BLOCKS:
        enough_mm = math.ceil(1e3 * voxel_m * math.sqrt(1.1 * blocks / MAX_BLOCKS))
        raise ConfigurationError(
            f"voxels of {1e3 * voxel_m:g} mm need {blocks:,} blocks of {SIDE}×{SIDE}×{SIDE} here, "
            f"more than the {MAX_BLOCKS:,} that 1.4 GB hold: take --voxel-mm {enough_mm}"
        )


def _blocks_of(image: RangeImage, voxel_m: float) -> Keys:
    measured = image.inverse_depth[image.inverse_depth > 0]
    if not measured.size:
        return np.empty(0, np.int64)
    reach_m = truncation_m(image.sigma_1m, 1.0 / float(measured.min()), voxel_m)
    rays = np.insert(pixel_rays(image.grid.intrinsics), 2, 1.0, axis=-1)
    longest = float(np.nanmax(np.linalg.norm(rays, axis=-1)))
    steps = 1 + max(1, math.ceil(2 * reach_m * longest / (0.5 * SIDE * voxel_m)))
    rows, columns = (-(-size // STRIDE_PX) for size in image.inverse_depth.shape)
    keys = np.empty(rows * columns * steps * 8, np.int64)
    R, origin = image.T_rig_grid[:3, :3], np.ascontiguousarray(image.T_rig_grid[:3, 3])
    count = list_blocks(image.inverse_depth, rays @ R.T, origin, image.sigma_1m, voxel_m, steps, keys)
    return np.unique(keys[:count])


def _camera(image: RangeImage) -> Camera:
    at = image.grid.intrinsics
    rays = pixel_rays(at)
    return Camera(
        T_grid_rig=np.ascontiguousarray(inverse(image.T_rig_grid)[:3]),
        lens=np.array([at.fx, at.fy, at.cx, at.cy, *at.dist]),
        widest=float(np.nanmax((rays**2).sum(axis=-1))),
        inverse_depth=image.inverse_depth,
        incidence=image.incidence,
        colors=image.colors,
        colored=image.colored,
        sigma_1m=image.sigma_1m,
        frames=image.frames,
    )
