"""Voxels: integer keys of points and sums over those that share one."""

import numpy as np
import numpy.typing as npt

Keys = npt.NDArray[np.int64]
Array = npt.NDArray[np.float64]

MIN_VOXEL_M = 1e-3
"""Finer than any noise of the sensor, and what keeps a key within 63 bits."""

KEY_BITS = 21
"""Of a voxel's index on an axis: ±1048 m at the smallest voxel."""


def voxel_keys(points_m: Array, voxel_m: float) -> Keys:
    """One integer (N,) a voxel for points (N,3), the same for points of the same voxel."""
    if voxel_m < MIN_VOXEL_M:
        raise ValueError(f"voxel_m is {voxel_m}, must be at least {MIN_VOXEL_M}")
    index = np.floor(points_m / voxel_m).astype(np.int64) + (1 << (KEY_BITS - 1))
    return np.asarray((index[:, 0] << (2 * KEY_BITS)) | (index[:, 1] << KEY_BITS) | index[:, 2])


def voxel_index(keys: Keys) -> Keys:
    """The voxels' places (N,3) on their lattice, from their keys (N,)."""
    parts = [keys >> (2 * KEY_BITS), keys >> KEY_BITS, keys]
    return np.stack([part & ((1 << KEY_BITS) - 1) for part in parts], axis=-1) - (1 << (KEY_BITS - 1))


def sum_by_key(keys: Keys, rows: Array) -> tuple[Keys, Array]:
    """Distinct keys, ascending, and the sums (M,C) of their rows (N,C)."""
    distinct, place = np.unique(keys, return_inverse=True)
    columns = [np.bincount(place, rows[:, k], len(distinct)) for k in range(rows.shape[1])]
    return distinct, np.column_stack(columns)
