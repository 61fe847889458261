"""Errors of a calibration against known true poses."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from rig_calib.alignment import align_frames
from rig_calib.normalised_error import Consistency, normalised_error
from rig_calib.rig_calibration import CalibratedEdge, RigCalibration
from rig_protocol.errors import DataError
from rig_protocol.poses import Pose, inverse, rotation_angle_deg

NEAR_LIMIT_DEG = 35.0
"""Pairs that look into directions less than this apart count as near: they should share a view."""

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class PoseError:
    """Rotation (degrees) and translation (millimetres) between an estimated and a true pose."""

    deg: float
    mm: float

    @classmethod
    def between(cls, estimated: Pose, true: Pose) -> "PoseError":
        """The error of one pose."""
        T = inverse(true) @ estimated
        return cls(rotation_angle_deg(T), float(np.linalg.norm(T[:3, 3]) * 1e3))


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """Mean, median and largest of several pose errors."""

    count: int
    mean: PoseError
    median: PoseError
    max: PoseError

    @classmethod
    def of(cls, errors: Iterable[PoseError]) -> "ErrorSummary | None":
        """The summary; None of nothing."""
        values = np.array([(error.deg, error.mm) for error in errors])
        if not len(values):
            return None
        mean, median, largest = (f(values, axis=0).tolist() for f in (np.mean, np.median, np.max))
        return cls(len(values), PoseError(*mean), PoseError(*median), PoseError(*largest))

    def to_dict(self) -> dict[str, float]:
        """Flat numbers for JSON."""
        out: dict[str, float] = {"count": self.count}
        for name, error in (("mean", self.mean), ("median", self.median), ("max", self.max)):
            out |= {f"{name}_deg": error.deg, f"{name}_mm": error.mm}
        return out


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Errors of relative poses by pair, and of every camera after aligning the rigs as wholes.

    `neighbours` are cameras of consecutive ids, in a closed ring the last and the first too; `used` the pairs
    whose edges the calibration used; `missing` the cameras of the truth that have no estimate. `pair_nees`
    and `camera_nees` are `normalised_error`s, where the calibration states the covariance.
    """

    pairs: Mapping[Pair, PoseError]
    neighbours: tuple[Pair, ...]
    used: tuple[Pair, ...]
    near: tuple[Pair, ...]
    cameras: Mapping[int, PoseError]
    missing: tuple[int, ...]
    pair_nees: Mapping[Pair, float] = field(default_factory=dict)
    camera_nees: Mapping[int, float] = field(default_factory=dict)

    def over(self, pairs: Iterable[Pair]) -> ErrorSummary | None:
        """Summary over some of the pairs."""
        return ErrorSummary.of(self.pairs[pair] for pair in pairs)

    @property
    def absolute(self) -> ErrorSummary | None:
        """Summary over the cameras."""
        return ErrorSummary.of(self.cameras.values())

    def summaries(self) -> dict[str, ErrorSummary]:
        """Every summary that exists, by its name."""
        found = {
            "neighbours": self.over(self.neighbours),
            "used": self.over(self.used),
            "near": self.over(self.near),
            "absolute": self.absolute,
        }
        return {name: summary for name, summary in found.items() if summary is not None}

    def consistency(self) -> dict[str, Consistency]:
        """Of `pairs` (neighbours and used edges) and of aligned `cameras`, where covariances are known."""
        found = {
            "pairs": Consistency.of(
                nees for pair, nees in self.pair_nees.items() if pair in self.used or pair in self.neighbours
            ),
            "cameras": Consistency.of(self.camera_nees.values()),
        }
        return {name: consistency for name, consistency in found.items() if consistency is not None}

    def to_dict(self) -> dict[str, Any]:
        """What `rig-calib evaluate --json` prints."""
        edges = [
            {
                "i": pair[0],
                "j": pair[1],
                "deg": error.deg,
                "mm": error.mm,
                "used": pair in self.used,
                "nees": self.pair_nees.get(pair),
            }
            for pair, error in self.pairs.items()
            if pair in self.used or pair in self.neighbours
        ]
        cameras = [
            {"id": c, "deg": error.deg, "mm": error.mm, "nees": self.camera_nees.get(c)}
            for c, error in self.cameras.items()
        ]
        summaries = {name: summary.to_dict() for name, summary in self.summaries().items()}
        return {
            **summaries,
            "near_limit_deg": NEAR_LIMIT_DEG,
            "edges": edges,
            "cameras": cameras,
            "consistency": {name: value.to_dict() for name, value in self.consistency().items()},
            "missing": list(self.missing),
        }


def evaluate(estimated: RigCalibration | Mapping[int, Pose], truth: Mapping[int, Pose]) -> Evaluation:
    """Compare a calibration, or T_rig_camera by id, with true poses; DataError without a common camera."""
    used: set[Pair] = set()
    calibration = estimated if isinstance(estimated, RigCalibration) else None
    if isinstance(estimated, RigCalibration):
        used = {_pair(edge) for edge in estimated.edges if edge.used}
        estimated = estimated.poses
    common = sorted(estimated.keys() & truth.keys())
    if not common:
        raise DataError(
            "the calibration and the truth have no camera in common: they belong to different rigs"
        )
    true = {(i, j): inverse(truth[i]) @ truth[j] for i, j in combinations(common, 2)}
    pairs = {(i, j): PoseError.between(inverse(estimated[i]) @ estimated[j], T) for (i, j), T in true.items()}
    T_truth_estimated = align_frames(estimated, truth)
    return Evaluation(
        pairs=pairs,
        neighbours=_neighbours(sorted(truth), true),
        used=tuple(pair for pair in pairs if pair in used),
        near=tuple(pair for pair, T in true.items() if rotation_angle_deg(T) < NEAR_LIMIT_DEG),
        cameras={c: PoseError.between(T_truth_estimated @ estimated[c], truth[c]) for c in common},
        missing=tuple(sorted(truth.keys() - estimated.keys())),
        pair_nees={} if calibration is None else _pair_nees(calibration, truth),
        camera_nees={} if calibration is None else _camera_nees(calibration, truth, T_truth_estimated),
    )


def _pair(edge: CalibratedEdge) -> Pair:
    return min(edge.i, edge.j), max(edge.i, edge.j)


def _pair_nees(calibration: RigCalibration, truth: Mapping[int, Pose]) -> dict[Pair, float]:
    """Of the adjusted relative pose of every edge whose cameras have a pose and a truth."""
    poses, found = calibration.poses, {}
    for edge in calibration.edges:
        if {edge.i, edge.j} <= poses.keys() & truth.keys():
            estimated, true = (inverse(T[edge.i]) @ T[edge.j] for T in (poses, truth))
            nees = normalised_error(estimated, true, edge.relative_covariance)
            if nees is not None:
                found[_pair(edge)] = nees
    return found


def _camera_nees(
    calibration: RigCalibration, truth: Mapping[int, Pose], T_truth_estimated: Pose
) -> dict[int, float]:
    """Of every aligned camera; nothing when the truth lacks one, for the alignment is over them all."""
    if not calibration.poses.keys() <= truth.keys():
        return {}
    found = {
        camera.id: normalised_error(
            T_truth_estimated @ camera.T_rig_camera, truth[camera.id], camera.aligned_covariance
        )
        for camera in calibration.cameras
    }
    return {camera_id: nees for camera_id, nees in found.items() if nees is not None}


def _neighbours(ids: list[int], true: Mapping[Pair, Pose]) -> tuple[Pair, ...]:
    """Consecutive cameras; in a closed ring, where they look almost the same way, the last and the first."""
    ends = (ids[0], ids[-1])
    closed = len(ids) > 2 and ends in true and rotation_angle_deg(true[ends]) < NEAR_LIMIT_DEG
    chain = [pair for pair in pairwise(ids) if pair in true]
    return (*chain, ends) if closed else tuple(chain)
