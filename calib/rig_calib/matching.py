"""Pairs of keypoints of two images that look alike."""

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.features import Keypoints
from rig_calib.overlap import Region

Matches = npt.NDArray[np.intp]
"""(N,2): row k pairs keypoint `[k, 0]` of the first image with keypoint `[k, 1]` of the second."""

_FLANN_KD_TREE = 1


def mutual_matches(
    a: Keypoints, b: Keypoints, regions: tuple[Region, Region], ratio: float, max_distance: float
) -> Matches:
    """Matches that are nearest both ways and clearly nearer than the second-nearest place (Lowe 2004)."""
    rows, columns = (np.flatnonzero(r.contains(k.pixels)) for r, k in zip(regions, (a, b), strict=True))
    if len(rows) < 2 or len(columns) < 2:
        return _no_matches()
    distance = _distances(a.descriptors[rows], b.descriptors[columns])
    nearest = distance.argmin(axis=1)
    index = np.arange(len(rows))
    mutual = distance.argmin(axis=0)[nearest] == index
    best = distance[index, nearest]
    # The same place described for another orientation is no competitor.
    same_place = b.place[columns][None, :] == b.place[columns][nearest][:, None]
    second = np.where(same_place, np.inf, distance).min(axis=1)
    keep = mutual & (best < ratio * second) & (best < max_distance)
    return _one_a_place(np.column_stack([rows[keep], columns[nearest[keep]]]), best[keep], a, b)


def flann_matches(
    a: Keypoints, b: Keypoints, regions: tuple[Region, Region], multiple: float, seed: int
) -> Matches:
    """The paper's matches: nearest by FLANN, at most `multiple` times the smallest distance apart."""
    rows, columns = (np.flatnonzero(r.contains(k.pixels)) for r, k in zip(regions, (a, b), strict=True))
    if len(rows) < 2 or len(columns) < 2:
        return _no_matches()
    cv2.setRNGSeed(seed)  # FLANN's trees are random
    matcher = cv2.FlannBasedMatcher({"algorithm": _FLANN_KD_TREE, "trees": 4}, {"checks": 64})
    found = matcher.match(a.descriptors[rows], b.descriptors[columns])
    pairs = np.array([(rows[match.queryIdx], columns[match.trainIdx]) for match in found], dtype=np.intp)
    distance = np.array([match.distance for match in found])
    keep = distance <= multiple * max(float(distance.min()), 1.0)
    return _one_a_place(pairs[keep], distance[keep], a, b)


def _distances(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    squared = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None, :] - 2.0 * (a @ b.T)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def _one_a_place(pairs: Matches, distance: npt.NDArray[np.floating], a: Keypoints, b: Keypoints) -> Matches:
    """At most one match for every place of either image: the nearest."""
    order = np.argsort(distance, kind="stable")
    for keypoints, side in ((a, 0), (b, 1)):
        _, first = np.unique(keypoints.place[pairs[order, side]], return_index=True)
        order = order[np.sort(first)]
    return pairs[np.sort(order)]


def _no_matches() -> Matches:
    return np.empty((0, 2), dtype=np.intp)
