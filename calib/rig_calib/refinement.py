"""Patches instead of keypoints: spread over every overlap, found in the other camera by direct alignment.

Poses and depth of a first estimate say where a pixel of one camera must lie in the other. Around that place
the image itself is aligned, to a few hundredths of a pixel and with the information that its texture holds;
where a wall is blank, depth is compared alone (a point-to-plane term). What is found takes the place of the
keypoints in the same adjustment.
"""

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
import numpy.typing as npt
import scipy.spatial

from rig_calib.depth_model import DepthCorrection
from rig_calib.features import Keypoints
from rig_calib.keypoint_depth import on_one_plane
from rig_calib.matching import Matches
from rig_calib.observed_camera import ObservedCamera
from rig_calib.overlap import Region
from rig_calib.parallel import in_threads
from rig_calib.patch_alignment import RADIUS_PX, ImageF32, align_patches
from rig_calib.projection import inside
from rig_calib.surface_transfer import surface_planes, transfer, transfer_affine
from rig_protocol.poses import Pose, inverse

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
Pair = tuple[int, int]

_CELL_PX = 16  # one patch a cell: closer ones share most of their pixels
_MIN_CORRELATION = 0.8
_MAX_SIGMA_PX = 0.15  # along an edge a patch slides to where it was started: that is no information
# Interpolation, the mosaic and the lens move a patch by this much that its residuals do not show.
_FLOOR_SIGMA_PX = 0.02
_SOURCE_SIGMA_PX = 0.01  # a patch defines its point: all of the error is in the other image
_BLANK_STEP = 2  # of the cells without texture, every second one compares depth
# A patch over the edge of a thing moves with that, while its depth may be the wall's behind it.
_MIN_FILLED = 0.9
_REACH_PX = 3.0  # farther than this, and than three standard deviations of the prediction, is another place
_PYRAMID_FROM_PX = 1.0  # predictions worse than this are looked for in smaller images first
_MAX_LEVELS = 2
_NO_MATCHES: Matches = np.empty((0, 2), dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedRig:
    """The cameras with patches as their keypoints, and the pairs (N,2) of them by pair of cameras.

    `found_share` of the patches with texture were found where they were looked for, by pair.
    """

    cameras: Mapping[int, ObservedCamera]
    matches: dict[Pair, Matches]
    found_share: Mapping[Pair, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Half:
    """Patches of a `source` camera found in a `target`."""

    source: int
    target: int
    source_pixels: Array
    target_pixels: Array
    information: Array  # on target_pixels
    textured: int = 0  # patches that were looked for ...
    found: int = 0  # ... and those of them that look alike at the place
    source_information: Array | None = None  # None: a patch, which defines its point


def refine(
    cameras: Mapping[int, ObservedCamera],
    regions: Mapping[Pair, tuple[Region, Region]],
    poses: Mapping[int, Pose],
    corrections: Mapping[int, DepthCorrection | None],
    prediction_px: Mapping[Pair, float],
    depth_only: Set[Pair] = frozenset(),
    keypoint_matches: Mapping[Pair, Matches] = MappingProxyType({}),
) -> RefinedRig:
    """Find patches for every pair whose cameras both have a pose; one without any keeps `keypoint_matches`.

    `prediction_px` is the standard deviation, in pixels, with which the poses predict where a patch lies.
    Pairs of `depth_only` compare depth alone, which leads to the right place from farther away than texture.
    """
    placed = [c for c in cameras if c in poses]
    spread = dict(zip(placed, in_threads(lambda c: _spread_pixels(cameras[c].image), placed), strict=True))
    pairs = [pair for pair in regions if pair[0] in poses and pair[1] in poses]

    def align(pair: Pair) -> list[_Half]:
        reach = None if pair in depth_only else prediction_px[pair]
        found = _align_pair(cameras, spread, pair, regions[pair], poses, corrections, reach)
        if any(len(half.source_pixels) for half in found):
            return found
        return [_keypoint_half(cameras, pair, keypoint_matches.get(pair, _NO_MATCHES))]

    halves = [half for both in in_threads(align, pairs) for half in both]
    return _collect(cameras, halves)


def _align_pair(
    cameras: Mapping[int, ObservedCamera],
    spread: Mapping[int, Index],
    pair: Pair,
    sides: tuple[Region, Region],
    poses: Mapping[int, Pose],
    corrections: Mapping[int, DepthCorrection | None],
    prediction_px: float | None,
) -> list[_Half]:
    """Patches of i found in j, and those of j found in i where the first have left a gap."""
    (i, j), halves = pair, []
    taken = np.empty((0, 2))
    for source, target, region in ((i, j, sides[0]), (j, i, sides[1])):
        pixels = spread[source][region.contains(spread[source].astype(np.float64))]
        pixels = pixels[~_near(pixels, taken)]
        T = inverse(poses[target]) @ poses[source]
        half = _align_half(
            cameras[source], cameras[target], T, pixels, corrections.get(source), prediction_px
        )
        taken = half.target_pixels
        halves.append(half)
    return halves


def _align_half(
    source: ObservedCamera,
    target: ObservedCamera,
    T_target_source: Pose,
    pixels: Index,
    correction: DepthCorrection | None,
    prediction_px: float | None,
) -> _Half:
    ids = source.view.camera_id, target.view.camera_id
    depth = source.depth_at(pixels.astype(np.float64))
    flat = on_one_plane(source.disparity, depth.grid_pixels, RADIUS_PX, _MIN_FILLED)
    pixels, depth = pixels[flat], depth.select(flat)
    colors = source.view.model.color, target.view.model.color
    planes = surface_planes(source.grid, depth, correction)
    start = transfer(*colors, T_target_source, planes, pixels.astype(np.float64))
    visible = inside(colors[1], start, -float(RADIUS_PX))
    pixels, planes, start = pixels[visible], planes[visible], start[visible]
    if prediction_px is None:
        return _Half(*ids, pixels.astype(np.float64), start, np.zeros((len(pixels), 2, 2)))
    affine = transfer_affine(*colors, T_target_source, planes, pixels.astype(np.float64))
    found, information, correlation = _align_from_coarse(
        source.image, target.image, pixels, start, affine, prediction_px
    )
    information = _with_floor(information)
    moved = np.linalg.norm(found - start, axis=1)
    alike = (correlation > _MIN_CORRELATION) & (moved < max(_REACH_PX, 3.0 * prediction_px))
    good = alike & (np.trace(information, axis1=1, axis2=2) > 0.0)
    textured = correlation >= 0
    blank = ~good & ~textured & (np.arange(len(pixels)) % _BLANK_STEP == 0)
    information[~good], found[~good] = 0.0, start[~good]
    keep = good | blank
    sizes = int(textured.sum()), int(alike.sum())
    return _Half(*ids, pixels[keep].astype(np.float64), found[keep], information[keep], *sizes)


def _keypoint_half(cameras: Mapping[int, ObservedCamera], pair: Pair, matches: Matches) -> _Half:
    i, j = pair
    a, b = cameras[i].keypoints, cameras[j].keypoints
    rows, columns = matches[:, 0], matches[:, 1]
    return _Half(
        i,
        j,
        a.pixels[rows],
        b.pixels[columns],
        b.information[columns],
        source_information=a.information[rows],
    )


def _align_from_coarse(
    source: ImageF32, target: ImageF32, pixels: Index, start: Array, affine: Array, prediction_px: float
) -> tuple[Array, Array, Array]:
    """Places, information and correlation; from coarse images to fine ones where the prediction is poor."""
    levels = int(np.clip(np.ceil(np.log2(max(prediction_px / _PYRAMID_FROM_PX, 1.0))), 0, _MAX_LEVELS))
    pyramids = [source], [target]
    for pyramid in pyramids:
        for _ in range(levels):
            pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), dtype=np.float32))
    at = start.copy()
    for level in range(levels, 0, -1):
        scale = 0.5**level
        coarse = np.rint(pixels * scale).astype(np.intp)
        # The coarse patch stands beside the fine one by what rounding took.
        beside = np.einsum("nij,nj->ni", affine, coarse / scale - pixels)
        result = align_patches(pyramids[0][level], pyramids[1][level], coarse, (at + beside) * scale, affine)
        better = result.correlation > _MIN_CORRELATION
        at[better] = result.pixels[better] / scale - beside[better]
    fine = align_patches(source, target, pixels, at, affine)
    return fine.pixels, fine.information, fine.correlation


def _with_floor(information: Array) -> Array:
    """Information (N,2,2) when an error of the floor's size joins the patch's own; none where it is poor."""
    values, vectors = np.linalg.eigh(information)
    values = np.where(values > 1.0 / _MAX_SIGMA_PX**2, values, 0.0)
    values = values / (1.0 + values * _FLOOR_SIGMA_PX**2)
    return np.asarray(np.einsum("nik,nk,njk->nij", vectors, values, vectors))


def _spread_pixels(image: ImageF32) -> Index:
    """In every cell of the image the pixel (column, row) whose neighbourhood has most texture."""
    texture = cv2.cornerMinEigenVal(image, blockSize=7, ksize=3)
    height, width = image.shape
    rows, columns = (height - 2 * RADIUS_PX) // _CELL_PX, (width - 2 * RADIUS_PX) // _CELL_PX
    part = texture[RADIUS_PX : RADIUS_PX + rows * _CELL_PX, RADIUS_PX : RADIUS_PX + columns * _CELL_PX]
    cells = part.reshape(rows, _CELL_PX, columns, _CELL_PX).swapaxes(1, 2).reshape(rows, columns, -1)
    down, right = np.divmod(cells.argmax(axis=2), _CELL_PX)
    row, column = np.mgrid[:rows, :columns] * _CELL_PX + RADIUS_PX
    return np.stack([column + right, row + down], axis=-1).reshape(-1, 2)


def _near(pixels: Index, taken: Array) -> Mask:
    """Which pixels (N,2) have one of `taken` (K,2) within a patch's reach."""
    if not len(taken) or not len(pixels):
        return np.zeros(len(pixels), dtype=bool)
    distance_px, _ = scipy.spatial.KDTree(taken).query(pixels, distance_upper_bound=0.75 * _CELL_PX)
    return np.isfinite(distance_px)


def _collect(cameras: Mapping[int, ObservedCamera], halves: Sequence[_Half]) -> RefinedRig:
    """The patches of all halves as keypoints of their cameras."""
    pixels: dict[int, list[Array]] = {c: [] for c in cameras}
    information: dict[int, list[Array]] = {c: [] for c in cameras}
    count = dict.fromkeys(cameras, 0)
    matches: dict[Pair, list[Matches]] = {}
    looked_for: Counter[Pair] = Counter()
    found: Counter[Pair] = Counter()

    def add(camera: int, places: Array, known: Array) -> Index:
        pixels[camera].append(places)
        information[camera].append(known)
        first, count[camera] = count[camera], count[camera] + len(places)
        return np.arange(first, count[camera])

    for half in halves:
        of_source = half.source_information
        if of_source is None:
            of_source = np.broadcast_to(np.eye(2) / _SOURCE_SIGMA_PX**2, half.information.shape)
        ends = {
            half.source: add(half.source, half.source_pixels, of_source),
            half.target: add(half.target, half.target_pixels, half.information),
        }
        pair = min(ends), max(ends)
        looked_for[pair] += half.textured
        found[pair] += half.found
        matches.setdefault(pair, []).append(np.column_stack([ends[pair[0]], ends[pair[1]]]))
    refined = in_threads(lambda c: cameras[c].with_keypoints(_keypoints(pixels[c], information[c])), cameras)
    return RefinedRig(
        dict(zip(cameras, refined, strict=True)),
        {pair: np.concatenate(rows) for pair, rows in matches.items()},
        {pair: found[pair] / count for pair, count in looked_for.items() if count},
    )


def _keypoints(pixels: Sequence[Array], information: Sequence[Array]) -> Keypoints:
    places = np.concatenate([np.empty((0, 2)), *pixels])
    known = np.concatenate([np.empty((0, 2, 2)), *information])
    return Keypoints(places, known, np.empty((len(places), 0), dtype=np.float32), np.arange(len(places)))
