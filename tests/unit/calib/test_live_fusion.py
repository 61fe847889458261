"""Live fusion: right place, right colour, no double walls, nothing that floats, whatever the threads."""

import tracemalloc
from collections.abc import Iterator, Mapping
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from rig_calib.depth_model import DepthCorrection, disparity_of_depth
from rig_calib.fusion.live import FusedFrame, LiveFusion, LiveFusionSettings
from rig_calib.fusion.ray_tables import PlacedGrid, ring_tables
from rig_calib.fusion.voxels import voxel_keys
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import NO_DISPARITY, ImageU8, PanoramicFrame, RgbdFrame
from rig_protocol.poses import inverse, se3_exp, transform_points
from support.box_room import CAMERA, MODEL, BoxRoom, calibration_of, ring_poses

ROOM = BoxRoom()
POSES = ring_poses()
MODELS = dict.fromkeys(POSES, MODEL)
CALIBRATION = calibration_of(POSES)
SETTINGS = LiveFusionSettings(depth_frame="color", circle_px=720)


def frame_of(camera_id: int, **changes: object) -> RgbdFrame:
    view = ROOM.view(camera_id, POSES[camera_id])
    frame = RgbdFrame(camera_id, 0, 0, color=view.color[0], depth_mm=view.depth_mm[0], depth_frame="color")
    return replace(frame, **changes)  # type: ignore[arg-type]


FRAMES = {camera_id: frame_of(camera_id) for camera_id in POSES}
PANORAMA = PanoramicFrame.of(7, FRAMES)


def with_frames(changes: Mapping[int, RgbdFrame | None]) -> PanoramicFrame:
    return PanoramicFrame.of(7, {**FRAMES, **changes})


def fused(
    panorama: PanoramicFrame = PANORAMA,
    calibration: RigCalibration = CALIBRATION,
    settings: LiveFusionSettings = SETTINGS,
) -> FusedFrame:
    with LiveFusion(calibration, MODELS, settings) as fusion:
        return fusion.fuse(panorama)


def points_of(frame: FusedFrame, camera_id: int) -> np.ndarray:
    k = frame.camera_ids.index(camera_id)
    return frame.points_m[frame.starts[k] : frame.starts[k + 1]]


def noisy_raw(frame: RgbdFrame, seed: int) -> RgbdFrame:
    disparity = disparity_of_depth(MODEL.raw_model, frame.depth_mm * 1e-3)  # type: ignore[operator]
    disparity += np.random.default_rng(seed).normal(0, 0.5, disparity.shape)
    return replace(frame, raw=np.rint(disparity).astype(np.uint16), depth_mm=None)


NOISY = PanoramicFrame.of(0, {i: noisy_raw(frame, i) for i, frame in FRAMES.items()})


def mosaic_of(color: ImageU8) -> ImageU8:
    """GRBG."""
    bayer = color[..., 1].copy()
    bayer[0::2, 1::2] = color[0::2, 1::2, 2]
    bayer[1::2, 0::2] = color[1::2, 0::2, 0]
    return bayer


@pytest.fixture(scope="module")
def whole() -> FusedFrame:
    return fused()


def test_every_point_lies_on_a_wall_in_the_rig_frame(whole: FusedFrame) -> None:
    assert whole.index == 7
    assert not whole.skipped
    assert len(whole.points_m) > 100_000
    error = ROOM.wall_error_m(whole.points_m)
    assert np.percentile(error, 95) < 0.003
    # Where two walls meet, neither the mean of 3×3 pixels nor a partner's nearest pixel lies on one of them.
    assert error.max() < 0.03


def test_points_have_the_colour_of_their_place(whole: FusedFrame) -> None:
    difference = np.abs(whole.colors - ROOM.colors(whole.points_m)).max(axis=1)
    assert np.percentile(difference, 99) < 5


def test_a_mosaic_gives_the_colours_of_the_image_that_it_was_made_of(whole: FusedFrame) -> None:
    mosaics = {i: replace(f, color=None, bayer=mosaic_of(f.color)) for i, f in FRAMES.items()}  # type: ignore[arg-type]
    colors = fused(PanoramicFrame.of(7, mosaics)).colors
    assert len(colors) == pytest.approx(len(whole.colors), rel=0.02)
    points = fused(PanoramicFrame.of(7, mosaics)).points_m
    assert np.percentile(np.abs(colors - ROOM.colors(points)).max(axis=1), 99) < 6


def test_raw_disparity_gives_the_same_walls(whole: FusedFrame) -> None:
    points = fused(NOISY).points_m
    assert len(points) > 0.9 * len(whole.points_m)
    # σ is 0.5 raw steps, at most 15 mm in this room; 3×3 pixels and two cameras make it less.
    assert np.median(ROOM.wall_error_m(points)) < 0.004


@pytest.mark.parametrize("threads", [1, 3])
def test_the_result_is_the_same_to_the_last_bit_for_any_number_of_threads(threads: int) -> None:
    expected, got = fused(NOISY), fused(NOISY, settings=replace(SETTINGS, threads=threads))
    for name in ("points_m", "colors", "starts", "panorama", "panorama_depth_m"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), name)


def test_a_frame_leaves_nothing_behind_for_the_next(whole: FusedFrame) -> None:
    with LiveFusion(CALIBRATION, MODELS, SETTINGS) as fusion:
        fusion.fuse(NOISY)
        fusion.fuse(with_frames({3: None}))
        again = fusion.fuse(PANORAMA)
        np.testing.assert_array_equal(again.points_m, whole.points_m)
        np.testing.assert_array_equal(again.panorama, whole.panorama)


def test_a_surface_that_two_cameras_see_is_owned_by_one(whole: FusedFrame) -> None:
    owners = np.repeat(np.arange(12), np.diff(whole.starts))
    voxels = voxel_keys(whole.points_m.astype(np.float64), 0.05)
    owned = np.unique(np.column_stack([voxels, owners]), axis=0)
    seen = np.concatenate([np.unique(voxel_keys(p, 0.05)) for p in each_alone()])
    shared_alone = 1 - len(np.unique(seen)) / len(seen)
    shared = 1 - len(np.unique(owned[:, 0])) / len(owned)
    assert shared_alone > 0.15
    assert shared < 0.04  # the cells through which a seam goes


def each_alone() -> Iterator[np.ndarray]:
    for camera_id in POSES:
        with LiveFusion(CALIBRATION, {camera_id: MODEL}, SETTINGS) as fusion:
            yield fusion.fuse(PANORAMA).points_m.astype(np.float64)


def test_walls_of_cameras_that_disagree_by_millimetres_become_one() -> None:
    """Cameras 0 and 1 measure 1.5 % too far and too near: 6 cm of a double wall at 2 m."""
    turned = {0: DepthCorrection((0.015,)), 1: DepthCorrection((-0.015,))}
    cameras = tuple(
        replace(camera, depth_correction=turned.get(camera.id)) for camera in CALIBRATION.cameras[:2]
    )
    calibration = replace(CALIBRATION, cameras=cameras)
    one, other = (points_of(fused(calibration=calibration), i) for i in (0, 1))
    seam = np.concatenate([one, other])
    keys = voxel_keys(seam.astype(np.float64), 0.04)
    both = np.intersect1d(keys[: len(one)], keys[len(one) :])
    radius = np.linalg.norm(seam, axis=1) / ROOM.distance_along(np.zeros(3), seam)
    radius /= np.linalg.norm(seam, axis=1)
    gaps = [
        np.median(radius[: len(one)][keys[: len(one)] == key])
        - np.median(radius[len(one) :][keys[len(one) :] == key])
        for key in both
    ]
    assert len(gaps) > 5
    assert np.median(np.abs(gaps)) < 0.005  # of the distance; 0.03 apart when nobody arbitrates


def test_flying_pixels_are_removed() -> None:
    frame = FRAMES[4]
    depth = frame.depth_mm.copy()  # type: ignore[union-attr]
    depth[40:80, 60:100] = 900  # a thing before the wall, and what a Kinect makes of its border
    depth[40:80, 58:60], depth[40:80, 100:102] = 1200, 1200
    cloud = points_of(fused(with_frames({4: replace(frame, depth_mm=depth)})), 4)
    depths = (cloud - POSES[4][:3, 3]) @ POSES[4][:3, 2]
    assert np.count_nonzero(np.abs(depths - 0.9) < 0.01) > 1000
    assert not np.any((depths > 0.93) & (depths < 1.28))


def test_islands_that_interference_leaves_are_removed() -> None:
    raw = noisy_raw(FRAMES[2], 0).raw.copy()  # type: ignore[union-attr]
    raw[30:90, 40:120] = NO_DISPARITY
    raw[58:63, 78:83] = 800
    cloud = points_of(fused(with_frames({2: replace(FRAMES[2], raw=raw, depth_mm=None)})), 2)
    assert ROOM.wall_error_m(cloud).max() < 0.1


def test_a_missing_camera_leaves_its_place_to_its_neighbours() -> None:
    frame = fused(with_frames({5: None}))
    assert frame.skipped == ("camera 5: left out, it delivered nothing",)
    assert len(points_of(frame, 5)) == 0
    assert len(points_of(frame, 4)) > len(points_of(fused(), 4))
    assert ROOM.wall_error_m(frame.points_m).max() < 0.03


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"damaged": True}, "its images are damaged"),
        ({"depth_mm": None}, "it delivered no colour with depth"),
        ({"color": None}, "it delivered no colour with depth"),
        ({"depth_frame": "depth"}, "its depth is in the depth camera, not as the settings have it"),
        ({"depth_mm": np.zeros((60, 80), np.uint16)}, "its images are not of the size that its model states"),
        ({"color": np.zeros((60, 80), np.uint8)}, "its images are not of the size that its model states"),
    ],
)
def test_a_camera_that_cannot_be_used_is_named_with_the_reason(
    changes: dict[str, object], reason: str
) -> None:
    assert fused(with_frames({1: frame_of(1, **changes)})).skipped == (f"camera 1: left out, {reason}",)


def test_the_panorama_shows_the_walls_at_their_distance_and_in_their_colour() -> None:
    with LiveFusion(CALIBRATION, MODELS, SETTINGS) as fusion:
        frame, rays = fusion.fuse(PANORAMA), fusion.cylinder.rays()
        points = (rays * frame.panorama_depth_m[..., None]) @ fusion.T_rig_view[:3, :3].T
        points += fusion.T_rig_view[:3, 3]
    shown = np.isfinite(frame.panorama_depth_m)
    assert shown.mean() > 0.85
    # A point falls half a pixel, four thousandths of a radian, beside the ray through the pixel's centre.
    assert np.percentile(ROOM.wall_error_m(points[shown]), 95) < 0.02
    color = frame.panorama[shown][:, ::-1].astype(np.float64)
    assert np.percentile(np.abs(color - ROOM.colors(points[shown])).max(axis=1), 95) < 8


def test_the_panorama_is_seen_from_the_centre_that_was_asked_for() -> None:
    centre = (0.3, -0.2, 0.1)
    with LiveFusion(CALIBRATION, MODELS, replace(SETTINGS, centre_m=centre)) as fusion:
        frame, rays = fusion.fuse(PANORAMA), fusion.cylinder.rays()
        points = (rays * frame.panorama_depth_m[..., None]) @ fusion.T_rig_view[:3, :3].T + centre
    shown = np.isfinite(frame.panorama_depth_m)
    assert np.percentile(ROOM.wall_error_m(points[shown]), 90) < 0.03


def test_gains_make_cameras_of_different_exposure_agree() -> None:
    dark = frame_of(6, color=np.rint(FRAMES[6].color * 0.5).astype(np.uint8))  # type: ignore[operator]
    frame = fused(with_frames({6: dark}), settings=replace(SETTINGS, gains={6: np.full(3, 2.0)}))
    difference = np.abs(frame.colors - ROOM.colors(frame.points_m)).max(axis=1)
    assert np.percentile(difference, 99) < 6


def test_depth_is_corrected_by_the_calibration() -> None:
    short = {i: frame_of(i, depth_mm=np.rint(f.depth_mm / 1.04).astype(np.uint16)) for i, f in FRAMES.items()}  # type: ignore[operator]
    cameras = tuple(
        replace(camera, depth_correction=DepthCorrection((0.04,))) for camera in CALIBRATION.cameras
    )
    frame = fused(PanoramicFrame.of(0, short), calibration=replace(CALIBRATION, cameras=cameras))
    assert np.percentile(ROOM.wall_error_m(frame.points_m), 95) < 0.003


def test_frames_cost_no_memory() -> None:
    with LiveFusion(CALIBRATION, MODELS, SETTINGS) as fusion:
        tracemalloc.start()
        for _ in range(100):  # the interpreter's pools of small objects fill up first
            fusion.fuse(PANORAMA)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for _ in range(200):
            fusion.fuse(PANORAMA)
        after, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # One image here is 77 kB in single precision: no frame leaves one behind, nor makes one for its time.
    assert after - before < 64 * 1024
    assert peak - before < 72 * 1024


def test_a_rig_that_cannot_be_fused_is_refused_with_the_reason() -> None:
    with pytest.raises(DataError, match="no camera has both a pose"):
        LiveFusion(calibration_of({}), MODELS, SETTINGS)
    small = replace(MODEL, color=replace(MODEL.color, height=100))
    with pytest.raises(DataError, match="one size"):
        LiveFusion(CALIBRATION, {**MODELS, 3: small}, SETTINGS)
    with pytest.raises(ConfigurationError, match="circle_px"):
        LiveFusionSettings(circle_px=3)
    with pytest.raises(ConfigurationError, match="threads"):
        LiveFusionSettings(threads=0)
    with pytest.raises(ConfigurationError, match="centre_m"):
        LiveFusionSettings(centre_m=(0.0, float("nan"), 1.0))
    with pytest.raises(
        ConfigurationError, match=r"circle_px 20000 makes a panorama of \d+ rows: take at most"
    ):
        LiveFusion(CALIBRATION, MODELS, replace(SETTINGS, circle_px=20_000))


def test_a_turned_rig_gives_a_turned_cloud(whole: FusedFrame) -> None:
    T = se3_exp(np.array([0.3, -0.2, 0.9, 1.0, -2.0, 0.5]))
    turned = fused(calibration=calibration_of({i: T @ pose for i, pose in POSES.items()}))
    back = (turned.points_m - T[:3, 3]) @ T[:3, :3]
    assert len(back) == pytest.approx(len(whole.points_m), rel=0.005)
    assert np.percentile(ROOM.wall_error_m(back), 95) < 0.003


def looking(position_m: tuple[float, float, float], azimuth_deg: float) -> np.ndarray:
    """T_rig_camera of an upright camera."""
    c, s = np.cos(np.deg2rad(azimuth_deg)), np.sin(np.deg2rad(azimuth_deg))
    T = np.eye(4)
    T[:3, :3] = np.column_stack([(s, -c, 0.0), (0.0, 0.0, -1.0), (c, s, 0.0)])
    T[:3, 3] = position_m
    return T


def inward_ring(radius_m: float) -> dict[int, np.ndarray]:
    """Four cameras that look at the axis."""
    places = {k: np.deg2rad(90.0 * k) for k in range(4)}
    return {
        k: looking((radius_m * np.cos(a), radius_m * np.sin(a), 0.1 * k), np.rad2deg(a) + 180)
        for k, a in places.items()
    }


@pytest.mark.parametrize(
    ("poses", "settings", "depth_mm"),
    [
        (POSES, replace(SETTINGS, centre_m=(1.85, 0.0, 0.0)), 1600),
        (inward_ring(1.5), SETTINGS, 1550),
    ],
    ids=["centre before a camera", "cameras that look across the ring"],
)
def test_a_cameras_window_holds_all_that_it_may_measure(
    poses: dict[int, np.ndarray],
    settings: LiveFusionSettings,
    depth_mm: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is lost that a window of the full circle would show."""
    flat = np.full_like(FRAMES[0].depth_mm, depth_mm)
    panorama = PanoramicFrame.of(0, {i: frame_of(i, depth_mm=flat) for i in poses})

    def shown() -> int:
        """How many pixels."""
        depth_m = fused(panorama, calibration_of(poses), settings).panorama_depth_m
        return int(np.count_nonzero(np.isfinite(depth_m)))

    got = shown()
    monkeypatch.setattr("rig_calib.fusion.ray_tables._window", lambda *_: (0, settings.circle_px))
    expected = shown()
    assert expected > 5_000
    # A window begins elsewhere: in single precision a point beside the border of a pixel may change sides.
    assert got == pytest.approx(expected, rel=0.003)


def test_an_open_panorama_reaches_the_borders_of_small_images_too() -> None:
    with LiveFusion(calibration_of({0: POSES[0]}), MODELS, SETTINGS) as fusion:
        shown_rad = fusion.cylinder.width / fusion.cylinder.pixels_per_rad
    assert shown_rad >= 2 * np.arctan((CAMERA.height - 1) / 2 / CAMERA.fy)  # it lies on its side


def test_a_row_looks_wherever_a_partner_may_see_what_it_measures() -> None:
    """Whatever the cameras' places, also where one looks across another's view between near and far."""
    poses = {
        0: looking((-3.0, 0.0, 0.0), 0),
        1: looking((0.0, -1.0, 0.0), 90),
        2: looking((2.0, 2.0, 0.5), -140),
    }
    grids = [PlacedGrid.of(MODEL, "color", T, None) for T in poses.values()]
    ring, generator = ring_tables(grids), np.random.default_rng(3)
    pixels = generator.integers((0, 0), (CAMERA.width, CAMERA.height), (20_000, 2))
    depths_m = generator.uniform(0.4, 8.0, len(pixels))
    for i, grid in enumerate(grids):
        rays = grid.rays()[pixels[:, 1], pixels[:, 0]]
        points = transform_points(grid.T_rig_grid, rays * depths_m[:, None])
        for j in set(range(len(grids))) - {i}:
            x, y, z = transform_points(inverse(grids[j].T_rig_grid), points).T
            u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
            seen = (z > 0.1) & (u > 0) & (u < CAMERA.width - 1) & (v > 0) & (v < CAMERA.height - 1)
            assert seen.any() == (j in ring.partners[i])
            [k] = np.flatnonzero(ring.partners[i] == j)
            first, last = ring.spans[i, k, pixels[seen, 1]].T
            assert np.all((first <= pixels[seen, 0]) & (pixels[seen, 0] < last))


def test_a_camera_whose_model_lacks_its_depth_camera_is_left_out_with_a_word(whole: FusedFrame) -> None:
    camera, T_color_depth = replace(CAMERA, fx=130.0), np.eye(4)
    full = replace(MODEL, depth=camera, T_color_depth=T_color_depth)
    settings = replace(SETTINGS, depth_frame="depth")
    panorama = with_frames({i: frame_of(i, depth_frame="depth") for i in POSES})
    with LiveFusion(CALIBRATION, {**dict.fromkeys(POSES, full), 4: MODEL}, settings) as fusion:
        frame = fusion.fuse(panorama)
    assert 4 not in frame.camera_ids
    assert len(frame.points_m) > 0.8 * len(whole.points_m)
    [told] = frame.skipped
    assert told.startswith("camera 4: left out, depth in the depth camera needs")
    with pytest.raises(DataError, match="camera 0: left out, depth in the depth camera needs"):
        LiveFusion(CALIBRATION, MODELS, settings)


def test_a_frame_that_fails_is_no_hindrance_to_the_next(
    whole: FusedFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    with LiveFusion(CALIBRATION, MODELS, replace(SETTINGS, threads=1)) as fusion:
        with monkeypatch.context() as patched:
            patched.setattr("rig_calib.fusion.live.pack_colors", Mock(side_effect=MemoryError))
            with pytest.raises(MemoryError):
                fusion.fuse(PANORAMA)
        np.testing.assert_array_equal(fusion.fuse(PANORAMA).panorama, whole.panorama)
