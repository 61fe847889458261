"""The panorama shows every direction at its true distance and colour, and is a picture on disk."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_calib.fusion.cylinder import Cylinder, complete, fill_small_holes, fit_cylinder, splat_distance
from rig_calib.fusion.panorama import Panorama, render_panorama
from rig_calib.fusion.panorama_picture import color_depth, depth_range_m, panorama_picture, write_panorama
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.view import views_from_panoramas
from rig_protocol.errors import DataError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.poses import Pose, se3_exp
from rig_protocol.rig_folder import read_frame, read_rig_description, read_true_poses
from support.box_room import BoxRoom, calibration_of, ring_poses, room_views
from support.real_data import real_data

ROOM = BoxRoom()
POSES = ring_poses()
CIRCLE_PX = 700
NAN = np.float32(np.nan)


@pytest.fixture(scope="module")
def panorama() -> Panorama:
    return render_panorama(room_views(POSES), calibration_of(POSES), circle_px=CIRCLE_PX)


def walls_of(panorama: Panorama) -> np.ndarray:
    """Where the rays of the panorama's pixels meet the room, (H,W,3)."""
    rays = panorama.cylinder.rays().astype(np.float64) @ panorama.T_rig_view[:3, :3].T
    origin = panorama.T_rig_view[:3, 3]
    return origin + rays * ROOM.distance_along(origin, rays)[..., None]


def test_every_pixel_holds_the_distance_of_the_wall_behind_it(panorama: Panorama) -> None:
    known = np.isfinite(panorama.depth_m)
    assert known.mean() > 0.95
    walls = walls_of(panorama) - panorama.T_rig_view[:3, 3]
    error = np.abs(panorama.depth_m - np.hypot(walls[..., 0], walls[..., 1]))[known]
    # A pixel is 9 mrad wide: half of one on a slanted wall 2.5 m away is a centimetre.
    assert np.median(error) < 0.006
    assert np.percentile(error, 99) < 0.03


def test_every_pixel_has_the_colour_of_the_wall_behind_it(panorama: Panorama) -> None:
    known = np.isfinite(panorama.depth_m)
    error = np.abs(panorama.color[..., ::-1] - ROOM.colors(walls_of(panorama)))[known].max(axis=1)
    assert np.percentile(error, 95) < 5


def test_a_full_ring_closes_with_its_first_camera_in_the_middle(panorama: Panorama) -> None:
    assert panorama.cylinder.closed
    assert panorama.cylinder.width == CIRCLE_PX
    middle = panorama.cylinder.column(np.array(panorama.camera_azimuths_rad["cam00"]))
    assert middle == pytest.approx(CIRCLE_PX / 2, abs=1)


def test_what_is_to_the_left_of_a_spectator_is_left_in_the_picture(panorama: Panorama) -> None:
    azimuths = np.array([panorama.camera_azimuths_rad[name] for name in ("cam01", "cam00", "cam11")])
    assert (np.diff(panorama.cylinder.column(azimuths)) > 0).all()


def test_exposures_leave_no_seams() -> None:
    exposures = [1.0, 1.15, 0.9, 1.1, 0.9, 1.0, 1.1, 0.95, 1.0, 1.1, 0.9, 1.05]
    panorama = render_panorama(room_views(POSES, exposures), calibration_of(POSES), circle_px=CIRCLE_PX)
    known = np.isfinite(panorama.depth_m) & panorama.color.any(axis=2)
    ratio = (panorama.color[..., ::-1] / ROOM.colors(walls_of(panorama)))[known]
    assert np.std(ratio) < 0.03


def test_a_few_cameras_give_an_open_panorama_of_their_directions() -> None:
    poses = ring_poses(3)
    panorama = render_panorama(room_views(poses), calibration_of(poses), circle_px=CIRCLE_PX)
    assert not panorama.cylinder.closed
    assert panorama.cylinder.width < CIRCLE_PX / 3
    assert np.isfinite(panorama.depth_m).mean() > 0.9


def test_a_rig_in_any_frame_gives_the_same_panorama(panorama: Panorama) -> None:
    T_other_rig = se3_exp(np.array([0.7, -1.1, 0.4, 3.0, -2.0, 1.0]))
    poses = {camera_id: T_other_rig @ T for camera_id, T in POSES.items()}
    other = render_panorama(room_views(POSES), calibration_of(poses, "camera 0"), circle_px=CIRCLE_PX)
    assert other.color.shape == panorama.color.shape
    assert np.mean(np.abs(other.color.astype(int) - panorama.color)) < 1.0


def test_without_any_camera_to_draw_it_says_so() -> None:
    with pytest.raises(DataError, match="no camera"):
        render_panorama(room_views(POSES), calibration_of({}))


def test_a_camera_without_depth_is_left_out_and_named() -> None:
    views = room_views(POSES)
    views[4] = replace(views[4], depth_mm=())
    panorama = render_panorama(views, calibration_of(POSES), circle_px=CIRCLE_PX)
    assert [sentence.split(":")[0] for sentence in panorama.skipped] == ["cam04"]
    assert "cam04" not in panorama.camera_azimuths_rad


# ---- viewpoint


def turned(T_rig_camera: Pose) -> Pose:
    """The same camera in landscape: image y down instead of image x."""
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]
    return T_rig_camera @ quarter


def test_the_axis_of_a_portrait_ring_is_found_without_a_drawing() -> None:
    T_other_rig = se3_exp(np.array([0.7, -1.1, 0.4, 3.0, -2.0, 1.0]))
    viewpoint = rig_viewpoint({k: T_other_rig @ T for k, T in POSES.items()})
    assert viewpoint.portrait
    assert viewpoint.T_rig_view[:3, 2] == pytest.approx(T_other_rig[:3, 2])
    assert viewpoint.T_rig_view[:3, 0] == pytest.approx(T_other_rig[:3, 0])
    assert viewpoint.T_rig_view[:3, 3] == pytest.approx(T_other_rig[:3, 3])


def test_cameras_that_look_to_one_side_are_taken_for_upright() -> None:
    viewpoint = rig_viewpoint({k: turned(T) for k, T in ring_poses(3).items()})
    assert not viewpoint.portrait
    assert viewpoint.T_rig_view[:3, 2] == pytest.approx([0, 0, 1])


def test_a_ring_of_landscape_cameras_is_told_from_a_portrait_one() -> None:
    viewpoint = rig_viewpoint({k: turned(T) for k, T in POSES.items()})
    assert not viewpoint.portrait
    assert viewpoint.T_rig_view[:3, 2] == pytest.approx([0, 0, 1])


def test_the_rings_own_axis_is_used_where_the_frame_is_the_rings() -> None:
    tilted = {k: T @ se3_exp(np.array([0, 0.1, 0, 0, 0, 0])) for k, T in ring_poses(3).items()}
    viewpoint = rig_viewpoint(tilted, "ring")
    assert viewpoint.portrait
    assert viewpoint.T_rig_view[:3, 2] == pytest.approx([0, 0, 1])


def test_a_viewpoint_needs_a_camera() -> None:
    with pytest.raises(ValueError, match="at least one"):
        rig_viewpoint({})


# ---- images of distance


def test_a_near_surface_hides_the_wall_behind_it() -> None:
    cylinder = Cylinder(40, 20, 40 / (2 * np.pi), np.pi, 1.5)
    points = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.02, 0.0, 0.0]])
    distance = splat_distance(cylinder, points, np.array([0.01, 0.01, 0.01], np.float32))
    assert np.nanmax(distance) == pytest.approx(1.01)


def test_pixels_where_no_point_falls_stay_unknown() -> None:
    cylinder = Cylinder(40, 20, 40 / (2 * np.pi), np.pi, 1.5)
    distance = splat_distance(cylinder, np.array([[1.0, 0, 0]]), np.array([0.01], np.float32))
    assert np.count_nonzero(np.isfinite(distance)) == 1


def test_points_come_back_from_their_pixel_and_distance() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3)) * (2, 2, 0.3)
    cylinder = fit_cylinder(points, 2000)
    distance = splat_distance(cylinder, points, np.full(len(points), 0.01, np.float32))
    rows, columns = np.nonzero(np.isfinite(distance))
    again = cylinder.rays()[rows, columns] * distance[rows, columns, None]
    nearest = np.linalg.norm(again[:, None] - points[None], axis=2).min(axis=1)
    assert nearest.max() < 0.03


def test_small_holes_are_filled_where_neighbours_agree() -> None:
    distance = np.full((20, 30), 2.0, np.float32)
    distance[8:11, 10:13] = NAN
    assert fill_small_holes(distance, closed=False) == pytest.approx(np.full((20, 30), 2.0))


def test_a_hole_between_a_near_and_a_far_surface_stays() -> None:
    distance = np.full((20, 30), 2.0, np.float32)
    distance[:, :14] = 1.0
    distance[:, 14:16] = NAN
    filled = fill_small_holes(distance, closed=False)
    assert set(np.unique(filled[np.isfinite(filled)])) == {np.float32(1.0), np.float32(2.0)}


def test_large_holes_and_the_surroundings_stay_unknown() -> None:
    distance = np.full((40, 60), NAN)
    distance[10:30, 10:50] = 2.0
    distance[12:28, 20:40] = NAN
    assert np.array_equal(np.isfinite(fill_small_holes(distance, closed=False)), np.isfinite(distance))


def test_a_hole_at_the_seam_of_a_closed_cylinder_is_filled() -> None:
    distance = np.full((20, 30), 2.0, np.float32)
    distance[:, 0], distance[:, -1] = NAN, NAN
    assert np.isfinite(fill_small_holes(distance, closed=True)).all()


def test_completion_keeps_what_is_known_and_stays_within_its_range() -> None:
    distance = np.random.default_rng(0).uniform(1, 3, (64, 90)).astype(np.float32)
    distance[20:50, 30:70] = NAN
    full = complete(distance, closed=True)
    known = np.isfinite(distance)
    assert full[known] == pytest.approx(distance[known])
    assert np.isfinite(full).all()
    assert (full[~known] > 1).all()
    assert (full[~known] < 3).all()


# ---- the picture


def test_the_picture_shows_colour_above_depth(tmp_path: Path, panorama: Panorama) -> None:
    write_panorama(tmp_path / "panorama.png", panorama)
    picture = cv2.imread(str(tmp_path / "panorama.png"))
    height, width = panorama.color.shape[:2]
    assert picture.shape[0] > 2 * height
    assert picture.shape[1] > width
    assert [path.name for path in tmp_path.iterdir()] == ["panorama.png"]


def test_a_narrow_panorama_without_any_depth_still_has_a_picture(panorama: Panorama) -> None:
    narrow = replace(panorama.cylinder, width=50)
    empty = replace(
        panorama,
        cylinder=narrow,
        color=panorama.color[:, :50],
        depth_m=np.full_like(panorama.depth_m[:, :50], NAN),
    )
    assert panorama_picture(empty).shape[1] >= 480


def test_near_and_far_have_different_colours_and_nothing_has_the_backgrounds() -> None:
    colored = color_depth(np.array([[1.0, 3.0, NAN]], np.float32), 1.0, 3.0)
    assert len(np.unique(colored.reshape(-1, 3), axis=0)) == 3


def test_the_scale_ends_on_half_metres() -> None:
    assert depth_range_m(np.linspace(1.1, 2.9, 100, dtype=np.float32)) == (1.0, 3.0)


def test_a_rendered_room_is_covered_without_gaps() -> None:
    folder = real_data("rendered_room")
    description = read_rig_description(folder)
    frames = {camera.id: read_frame(folder, camera, 0) for camera in description.cameras[:4]}
    views = views_from_panoramas(description, [PanoramicFrame(0, 0, frames, 0)])[:4]
    panorama = render_panorama(views, calibration_of(read_true_poses(folder)), circle_px=700)
    middle = slice(panorama.color.shape[0] // 4, 3 * panorama.color.shape[0] // 4)
    assert panorama.color[middle].any(axis=2).mean() > 0.99
    assert np.isfinite(panorama.depth_m[middle]).mean() > 0.9  # the screen and the shadows beside furniture
