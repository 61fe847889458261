"""The mesh where a volume's distance is zero: marching cubes, tile by tile, welded without seams.

Method: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees, 2003,
in scikit-image.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import scipy.spatial

from rig_calib.fusion.voxels import voxel_index, voxel_keys
from rig_calib.tsdf.kernels import SIDE
from rig_calib.tsdf.mesh import Array, Index, Mesh
from rig_calib.tsdf.volume import Volume
from rig_protocol.frames import ImageU8

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_TILE_BLOCKS = 8  # along an edge of what is taken at a time: 1 MB
_TILE = _TILE_BLOCKS * SIDE
_LEAST_SHARE = 2e-3  # of a voxel: no vertex comes to lie on a voxel, where edges meet ...
_ON_LATTICE = 1e-5  # ... and all are farther from there than single precision errs
_NO_COLOR = 128


def extract_mesh(volume: Volume) -> Mesh:
    """The surface between voxels before and behind it, where all eight corners of a cube are known."""
    vertices, faces, first = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for tile_vertices, tile_faces in _tiles(volume):
        vertices.append(tile_vertices)
        faces.append(tile_faces + first)
        first += len(tile_vertices)
    positions, joined = _weld(np.concatenate(vertices), np.concatenate(faces))
    return Mesh(positions * volume.voxel_m, joined, _vertex_colors(volume, positions))


def _tiles(volume: Volume) -> Iterator[tuple[Array, Index]]:
    """Vertices (n,3), in voxels, and faces (m,3) of every tile: those of cubes that begin in it."""
    from skimage.measure import marching_cubes

    blocks, distances = voxel_index(volume.keys), volume.distances_m()
    rows = {tuple(block): row for row, block in enumerate(blocks.tolist())}
    least_m = _LEAST_SHARE * volume.voxel_m
    for tile in np.unique(blocks // _TILE_BLOCKS, axis=0):
        field = _field(tile * _TILE_BLOCKS, rows, distances)
        crossed = _crossed(field)
        if crossed.any():
            field = np.where(np.abs(field) < least_m, np.copysign(np.float32(least_m), field), field)
            field[np.isnan(field)] = 1.0
            mask = np.pad(crossed, ((1, 0),) * 3)  # scikit-image names a cube by its highest corner
            found, faces, _, _ = marching_cubes(field, 0.0, mask=mask)
            yield found.astype(np.float64) + tile * _TILE, faces.astype(np.int64)


def _field(first: Index, rows: dict[tuple[int, ...], int], distances: Array32) -> Array32:
    """Distances of the voxels of a tile and of the next ones' first, NaN where nothing is known."""
    size = _TILE_BLOCKS + 1
    field = np.full((size * SIDE,) * 3, np.nan, np.float32)
    for i, j, k in np.ndindex(size, size, size):
        row = rows.get((int(first[0]) + i, int(first[1]) + j, int(first[2]) + k))
        if row is not None:
            at = tuple(slice(n * SIDE, (n + 1) * SIDE) for n in (i, j, k))
            field[at] = distances[row].reshape(SIDE, SIDE, SIDE)
    return field[: _TILE + 1, : _TILE + 1, : _TILE + 1]


def _crossed(field: Array32) -> Mask:
    """Cubes, by their lowest corner, all of whose corners are known and not all on one side."""
    low, high = field, field
    for axis in range(3):
        here = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        next_ = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        low, high = np.minimum(low[here], low[next_]), np.maximum(high[here], high[next_])
    return np.asarray((low < 0) & (high >= 0))  # NaN is neither


def _weld(vertices: Array, faces: Index) -> tuple[Array, Index]:
    """One vertex for all that lie on the same edge of the lattice (or within the same cube)."""
    if not len(vertices):
        return vertices, faces
    nearest = np.rint(vertices)
    between = np.abs(vertices - nearest) > _ON_LATTICE
    lowest = np.where(between, np.floor(vertices), nearest).astype(np.int64)
    lowest -= lowest.min(axis=0)
    axis = np.where(between.sum(axis=1) == 1, between.argmax(axis=1), 3)
    size = lowest.max(axis=0) + 1
    key = ((lowest[:, 0] * size[1] + lowest[:, 1]) * size[2] + lowest[:, 2]) * 4 + axis
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    return vertices[first], place[faces]


def _vertex_colors(volume: Volume, positions: Array) -> ImageU8:
    """Colours (N,3) at positions, in voxels, between those of the two ends of their edges.

    A vertex that no colour camera saw takes that of the nearest one.
    """
    low = np.floor(positions + _ON_LATTICE)
    share = (positions - low).max(axis=1, initial=0.0)
    colors, weights = np.zeros_like(positions), np.zeros(len(positions))
    for end, part in ((low, 1.0 - share), (np.ceil(positions - _ON_LATTICE), share)):
        own, known = _voxel_colors(volume, end)
        weight = np.where(known, np.maximum(part, 1e-6), 0.0)
        colors += own * weight[:, None]
        weights += weight
    seen = weights > 0
    colors[seen] /= weights[seen, None]
    colors[~seen] = _NO_COLOR
    if seen.any() and not seen.all():
        _, nearest = scipy.spatial.KDTree(positions[seen]).query(positions[~seen])
        colors[~seen] = colors[seen][nearest]
    return np.asarray(np.clip(np.rint(colors), 0, 255), dtype=np.uint8)


def _voxel_colors(volume: Volume, voxels: Array) -> tuple[Array, Mask]:
    """Mean colours (N,3) of voxels (N,3) that have a block, and which have a colour."""
    if not len(voxels):
        return np.empty((0, 3)), np.empty(0, np.bool_)
    rows = np.searchsorted(volume.keys, voxel_keys(voxels, SIDE))
    inner = voxels.astype(np.int64) % SIDE
    place = (inner[:, 0] * SIDE + inner[:, 1]) * SIDE + inner[:, 2]
    weight = volume.sums.color_weight[rows, place]
    return volume.sums.color[rows, place] / np.maximum(weight, 1)[:, None], weight > 0
