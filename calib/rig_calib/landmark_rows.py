"""All observations of a problem as rows of one least-squares system, in the order that elimination wants."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_calib.normal_equations import Groups
from rig_calib.observation_kernels import Cameras, disparity_rows, pixel_rows, plane_rows
from rig_calib.observation_model import FactoryModels, Observations, PlaneObservations
from rig_protocol.poses import hat

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]


class Rows(NamedTuple):
    """N scalar residuals (N,), whitened, and their derivatives by state (N,S) and by landmark (N,3)."""

    residual: Array
    by_state: Array
    by_landmark: Array

    def part(self, rows: slice) -> "Rows":
        """Some of the rows, as views."""
        return Rows(self.residual[rows], self.by_state[rows], self.by_landmark[rows])


@dataclass(frozen=True, slots=True, eq=False)
class GravityObservations:
    """Down as cameras (M,) measured it: unit `directions` (M,3) in the camera frame, `sigma` (M,) in rad."""

    camera: Index
    directions: Array
    sigma: Array

    def __len__(self) -> int:
        """How many cameras measured it."""
        return len(self.camera)

    def rows(self, cameras: Cameras, down: Array, out: Rows) -> None:
        """Three rows a camera: `down` (3,), rig frame, turned into the camera, less what it measured."""
        R = cameras.R_rig_camera[self.camera]
        weight = 1.0 / self.sigma[:, None]
        turned = down @ R
        out.residual[:] = ((turned - self.directions) * weight).ravel()
        out.by_state[:, :3] = (hat(turned) * weight[..., None]).reshape(-1, 3)
        out.by_landmark[:] = (R.transpose(0, 2, 1) * weight[..., None]).reshape(-1, 3)


class LandmarkCounts(NamedTuple):
    """How many points and planes a problem has."""

    points: int
    planes: int = 0


class LandmarkRows:
    """The observations of points, of planes, and of gravity (a landmark at infinity), in this order."""

    def __init__(
        self,
        models: FactoryModels,
        counts: LandmarkCounts,
        seen: Observations,
        seen_planes: PlaneObservations,
        gravity: GravityObservations,
    ) -> None:
        """Observations may come in any order."""
        self._point_order = np.lexsort((seen.camera, seen.point))
        self._plane_order = np.lexsort((seen_planes.camera, seen_planes.plane))
        self._points = models.point_rows(seen.select(self._point_order))
        self._planes = models.plane_rows(seen_planes.select(self._plane_order))
        self._gravity = gravity
        self._row_counts = 3 * len(seen), len(seen_planes), 3 * len(gravity)
        self._landmark_counts = *counts, min(len(gravity), 1)
        self._state_size = models.state_size
        self.groups = _joined(
            _groups(self._points.camera, self._points.point, counts.points, 3),
            _groups(self._planes.camera, self._planes.plane, counts.planes, 1),
            _groups(gravity.camera, np.zeros(len(gravity), np.intp), min(len(gravity), 1), 3),
        )
        blocks = np.concatenate(
            [[0], np.tile([2, 1], len(seen)), np.ones(len(seen_planes)), np.full(len(gravity), 3)]
        )
        self.kernels = np.cumsum(blocks).astype(np.intp)
        """Where (K+1,) the blocks of rows begin that share a robust kernel each."""

    def rows(self, cameras: Cameras, landmarks: Array) -> Rows:
        """The rows of all observations of `landmarks` (L,3)."""
        total = sum(self._row_counts)
        rows = Rows(np.zeros(total), np.zeros((total, self._state_size)), np.zeros((total, 3)))
        of_points, of_planes, of_gravity = map(rows.part, _slices(self._row_counts))
        points, planes, down = (landmarks[part] for part in _slices(self._landmark_counts))
        pixel_rows(cameras, self._points, points, *of_points)
        disparity_rows(cameras, self._points, points, *of_points)
        if len(of_planes.residual):
            plane_rows(cameras, self._planes, planes, *of_planes)
        if len(of_gravity.residual):
            self._gravity.rows(cameras, down[0], of_gravity)
        return rows

    def split_landmarks(self, landmarks: Array) -> tuple[Array, Array]:
        """Points (P,3) and planes (K,3) of `landmarks`."""
        points, planes, _ = (landmarks[part] for part in _slices(self._landmark_counts))
        return points, planes

    def split_residuals(self, residual: Array) -> tuple[Array, Array]:
        """Residuals of points (M,3) and of planes, in the order in which the observations were given."""
        of_points, of_planes, _ = (residual[part] for part in _slices(self._row_counts))
        points, planes = np.empty((len(self._point_order), 3)), np.empty(len(self._plane_order))
        points[self._point_order] = of_points.reshape(-1, 3)
        planes[self._plane_order] = of_planes
        return points, planes


def _slices(counts: tuple[int, ...]) -> list[slice]:
    return [slice(end - count, end) for count, end in zip(counts, np.cumsum(counts).tolist(), strict=True)]


def _groups(camera: Index, landmark: Index, landmark_count: int, rows_each: int) -> Groups:
    """Groups of observations, sorted by landmark and then camera, each of which has so many rows."""
    differs = (np.diff(landmark, prepend=-1) != 0) | (np.diff(camera, prepend=-1) != 0)
    first = np.flatnonzero(differs)
    first_group = np.searchsorted(landmark[first], np.arange(landmark_count + 1))
    first_row = np.append(first, len(camera)) * rows_each
    return Groups(camera[first].astype(np.intp), first_row.astype(np.intp), first_group.astype(np.intp))


def _joined(*parts: Groups) -> Groups:
    """Groups of several kinds of landmarks, one kind after the other."""
    zero, rows, groups = [np.zeros(1, np.intp)], 0, 0
    first_row, first_group = list(zero), list(zero)
    for part in parts:
        first_row.append(part.first_row[1:] + rows)
        first_group.append(part.first_group[1:] + groups)
        rows, groups = rows + part.first_row[-1], groups + len(part.camera)
    cameras = np.concatenate([part.camera for part in parts])
    return Groups(cameras, np.concatenate(first_row), np.concatenate(first_group))
