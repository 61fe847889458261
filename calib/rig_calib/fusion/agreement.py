"""How well the surfaces of different cameras agree where they overlap."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from rig_calib.fusion.sampling import sample_image
from rig_calib.fusion.surface import Array32, Surface
from rig_calib.fusion.visibility import in_field
from rig_calib.projection import inside, project
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]

_CELL_PX = 2
_STRIDE = 5  # points looked at: every fifth says as much as all, for they are correlated
_SAME_SURFACE_M = 0.15  # what differs by more are two surfaces, one behind the other
_MIN_POINTS = 200


def overlap_differences_m(
    surfaces: Sequence[Surface], intrinsics: Mapping[int, Intrinsics], poses: Mapping[int, Pose]
) -> dict[tuple[int, int], float]:
    """Median absolute difference of depth, along camera j's axis, where cameras i and j see one surface.

    Keys are pairs of camera ids with a common view, both ways; `intrinsics` of the colour cameras.
    """
    found = {}
    for seen_by in surfaces:
        camera = intrinsics[seen_by.camera_id]
        depth_map = _depth_map(seen_by, camera)
        for other in surfaces:
            if other is not seen_by:
                T_j_i = inverse(poses[seen_by.camera_id]) @ poses[other.camera_id]
                points = transform_points(T_j_i, other.points_m[::_STRIDE].astype(np.float64))
                difference = _differences(points, camera, depth_map)
                if len(difference) >= _MIN_POINTS:
                    found[other.camera_id, seen_by.camera_id] = float(np.median(difference))
    return found


def _depth_map(surface: Surface, camera: Intrinsics) -> Array32:
    """Mean depth of the surface's points in each cell of its camera's image, NaN where there are none."""
    points = surface.points_m.astype(np.float64)
    shape = (camera.height // _CELL_PX + 1, camera.width // _CELL_PX + 1)
    cells = np.rint(_in_cells(project(camera, points))).astype(np.intp)
    columns, rows = np.clip(cells, 0, np.array(shape[::-1]) - 1).T
    index = rows * shape[1] + columns
    count = np.bincount(index, minlength=shape[0] * shape[1])
    with np.errstate(invalid="ignore"):  # 0/0 is the NaN that marks an empty cell
        mean = np.bincount(index, points[:, 2], shape[0] * shape[1]) / count
    return mean.reshape(shape).astype(np.float32)


def _differences(points: Array, camera: Intrinsics, depth_map: Array32) -> Array:
    points = points[in_field(camera, points)]
    pixels = project(camera, points)
    seen = inside(camera, pixels)
    difference = np.abs(sample_image(depth_map, _in_cells(pixels[seen])) - points[seen, 2])
    return np.asarray(difference[difference < _SAME_SURFACE_M])


def _in_cells(pixels: Array) -> Array:
    """Coordinates in units of cells, whose centres are at integers."""
    return np.asarray((pixels + 0.5) / _CELL_PX - 0.5)
