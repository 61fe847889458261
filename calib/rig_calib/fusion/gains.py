"""Colour gains: what makes cameras of different exposure and white balance agree where they overlap.

Method: gain compensation of Brown & Lowe, Automatic Panoramic Image Stitching, IJCV 2007, on the
logarithm of each colour channel, so that it is linear.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rig_calib.fusion.surface import Surface, camera_surfaces
from rig_calib.fusion.voxels import Array, Keys, sum_by_key, voxel_keys
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import views_from_panoramas
from rig_protocol.frames import PanoramicFrame
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RigDescription

Gain = Array


NO_GAIN: Gain = np.ones(3)

_CELL_M = 0.05  # large against misalignment, small against what changes colour
_MIN_SHARED_CELLS = 30  # fewer common cells say nothing of an exposure
_DARK, _BRIGHT = 8.0, 247.0  # outside, a channel is noise or saturated and its ratio is no exposure
_RATIO_SIGMA = 0.1  # of one pair's log ratio, next to ...
_GAIN_SIGMA = 0.3  # ... how far gains stray from one: keeps the chain of ratios from drifting


def color_gains(surfaces: Sequence[Surface], poses: Mapping[int, Pose]) -> dict[int, Gain]:
    """A factor (3,), RGB, by camera id; their geometric mean is one."""
    cells = [_cell_colors(surface, poses[surface.camera_id]) for surface in surfaces]
    rows: list[Array] = []
    ratios: list[Array] = []
    for a in range(len(surfaces)):
        for b in range(a + 1, len(surfaces)):
            ratio = _log_ratio(cells[a], cells[b])
            if ratio is not None:
                row = np.zeros(len(surfaces))
                row[a], row[b] = 1.0, -1.0
                rows.append(row / _RATIO_SIGMA)
                ratios.append(ratio / _RATIO_SIGMA)
    rows += list(np.eye(len(surfaces)) / _GAIN_SIGMA)
    ratios += [np.zeros(3)] * len(surfaces)
    if not surfaces:
        return {}
    log_gains = np.linalg.lstsq(np.array(rows), np.array(ratios), rcond=None)[0]
    log_gains -= log_gains.mean(axis=0)
    return {surface.camera_id: np.exp(gain) for surface, gain in zip(surfaces, log_gains, strict=True)}


def frame_gains(
    description: RigDescription, panorama: PanoramicFrame, calibration: RigCalibration
) -> dict[int, Gain]:
    """The gains by one panoramic frame; takes a second or two for twelve cameras."""
    views = views_from_panoramas(description, [panorama])
    surfaces, _ = camera_surfaces(views, calibration)
    return color_gains(surfaces, calibration.poses)


def _cell_colors(surface: Surface, T_rig_camera: Pose) -> tuple[Keys, Array]:
    points = surface.points_at(T_rig_camera)
    counted = np.column_stack([np.ones(len(points)), surface.colors])
    keys, sums = sum_by_key(voxel_keys(points, _CELL_M), counted)
    return keys, sums[:, 1:] / sums[:, :1]


def _log_ratio(
    a: tuple[Keys, Array],
    b: tuple[Keys, Array],
) -> Array | None:
    """What must be added to log gain a minus log gain b, (3,); None without a sound overlap."""
    _, in_a, in_b = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    colors_a, colors_b = a[1][in_a], b[1][in_b]
    both = np.concatenate([colors_a, colors_b], axis=1)
    sound = ((both > _DARK) & (both < _BRIGHT)).all(axis=1)
    if np.count_nonzero(sound) < _MIN_SHARED_CELLS:
        return None
    return np.asarray(np.median(np.log(colors_b[sound] / colors_a[sound]), axis=0))
