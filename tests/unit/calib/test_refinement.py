"""Patches of two simulated neighbours against the truth, and what takes their place without any."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.units import draw_unit
from rig_calib.observed_camera import ObservedCamera, observe
from rig_calib.overlap import Region, shared_regions, whole_image
from rig_calib.refinement import RefinedRig, refine
from rig_calib.settings import CalibrationSettings
from rig_calib.view import views_from_panoramas
from rig_protocol.frames import PanoramicFrame
from rig_protocol.poses import Pose, inverse, se3_exp, transform_points
from support.synthetic_rig import MODEL, SyntheticRig, true_matches
from support.true_optics import first_hits, pixels_of_points, rays_of_pixels

# Factory intrinsics and the drawing are right here: what is left is what alignment adds.
SETTINGS = SimulatorSettings(
    cameras=2,
    seed=4,
    blocked_overlaps=0,
    factory_error=0.0,
    lens_residual_k1=0.0,
    depth_bias=0.0,
    depth_distortion_mm=0.0,
)
PAIR = (0, 1)
PREDICTION_PX = {PAIR: 0.5}
NO_CORRECTION = {0: None, 1: None}
# What a first estimate leaves: about a pixel.
OFF = se3_exp(np.array([0.001, 0.0015, -0.001, 0.001, 0.0, 0.001]))
Regions = dict[tuple[int, int], tuple[Region, Region]]


@pytest.fixture(scope="module")
def cameras() -> Mapping[int, ObservedCamera]:
    rig = VirtualRig(SETTINGS)
    panorama = PanoramicFrame.of(0, {c: rig.camera(c).frame(0) for c in PAIR})
    views = views_from_panoramas(rig_description(SETTINGS), [panorama])
    return {
        view.camera_id: observe(view, [whole_image(view.model.color)], CalibrationSettings())
        for view in views
    }


@pytest.fixture(scope="module")
def regions(cameras: Mapping[int, ObservedCamera]) -> Regions:
    return shared_regions(
        {c: camera.view.model.color for c, camera in cameras.items()},
        {c: camera.view.T_rig_nominal for c, camera in cameras.items()},
        7.0,
    )


@pytest.fixture(scope="module")
def refined(cameras: Mapping[int, ObservedCamera], regions: Regions) -> RefinedRig:
    return refine(cameras, regions, poses_off(), NO_CORRECTION, PREDICTION_PX)


def poses_off() -> dict[int, Pose]:
    truth = true_poses(SETTINGS)
    return {0: truth[0], 1: truth[1] @ OFF}


def true_pixels(pixels: np.ndarray, source: int, target: int) -> np.ndarray:
    """Where (N,2) the target truly sees what the source sees at its pixels."""
    truth, scene = true_poses(SETTINGS), VirtualRig(SETTINGS).scene
    lenses = {c: draw_unit(SETTINGS, c).color for c in PAIR}
    hits = first_hits(
        scene.surfaces, scene.T_room_rig @ truth[source], rays_of_pixels(lenses[source], pixels)
    )
    return pixels_of_points(
        lenses[target], transform_points(inverse(truth[target]) @ truth[source], hits.points)
    )


def textured_errors_px(rig: RefinedRig) -> np.ndarray:
    """Errors (N,2) of the patches that are known across and along, by the truth about their source."""
    keypoints = [rig.cameras[c].keypoints for c in PAIR]
    ends = [side.pixels[rows] for side, rows in zip(keypoints, rig.matches[PAIR].T, strict=True)]
    known = [
        np.linalg.eigvalsh(side.information[rows])[:, 0]
        for side, rows in zip(keypoints, rig.matches[PAIR].T, strict=True)
    ]
    in_second = (known[0] > known[1]) & (known[1] > 0)  # the source is the end that is known exactly
    in_first = (known[1] > known[0]) & (known[0] > 0)
    return np.concatenate(
        [
            ends[1][in_second] - true_pixels(ends[0][in_second], 0, 1),
            ends[0][in_first] - true_pixels(ends[1][in_first], 1, 0),
        ]
    )


def test_patches_lie_within_a_tenth_of_a_pixel_of_the_truth(refined: RefinedRig) -> None:
    errors = textured_errors_px(refined)
    assert len(errors) > 100
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.1


def test_the_start_was_off_by_more_than_the_patches_are(
    cameras: Mapping[int, ObservedCamera], regions: Regions
) -> None:
    """The yardstick itself: without alignment the same places are predicted far worse."""
    predicted = refine(cameras, regions, poses_off(), NO_CORRECTION, PREDICTION_PX, {PAIR})
    rows = predicted.matches[PAIR]
    a, b = (predicted.cameras[c].keypoints.pixels for c in PAIR)
    from_second = predicted.cameras[1].keypoints.information[rows[:, 1]].any(axis=(1, 2))
    start = b[rows[~from_second, 1]] - true_pixels(a[rows[~from_second, 0]], 0, 1)
    assert np.median(np.linalg.norm(start, axis=1)) > 0.5


def test_pairs_of_depth_only_carry_no_pixel_information(
    cameras: Mapping[int, ObservedCamera], regions: Regions
) -> None:
    """One end defines the point, the other is compared by depth alone."""
    found = refine(cameras, regions, poses_off(), NO_CORRECTION, PREDICTION_PX, {PAIR})
    rows = found.matches[PAIR]
    ends = np.column_stack([found.cameras[c].keypoints.has_place[rows[:, k]] for k, c in enumerate(PAIR)])
    assert len(rows) > 100
    assert (ends.sum(axis=1) == 1).all()
    assert all(found.cameras[c].depth.known.mean() > 0.5 for c in PAIR)


def test_a_patch_whose_depth_may_be_the_walls_behind_a_thing_is_not_taken(
    cameras: Mapping[int, ObservedCamera], regions: Regions, refined: RefinedRig
) -> None:
    """Beside a hole or a step the depth of one place says little of the texture around it."""
    torn = {c: replace(camera, disparity=camera.disparity.copy()) for c, camera in cameras.items()}
    for camera in torn.values():
        camera.disparity[::6] = np.nan  # two or three of a patch's fifteen rows: a plane fits all the same
    there = refine(torn, regions, poses_off(), NO_CORRECTION, PREDICTION_PX)
    assert len(refined.matches[PAIR]) > 100
    assert len(there.matches[PAIR]) == 0


def test_textures_are_found_where_the_poses_are_right_and_hardly_where_they_are_wrong(
    cameras: Mapping[int, ObservedCamera], regions: Regions, refined: RefinedRig
) -> None:
    aside = se3_exp(np.array([0.0, 0.0, 0.0, 0.15, 0.0, 0.0]))
    wrong = {0: poses_off()[0], 1: poses_off()[1] @ aside}
    elsewhere = refine(cameras, regions, wrong, NO_CORRECTION, PREDICTION_PX)
    assert refined.found_share[PAIR] > 0.7
    assert elsewhere.found_share[PAIR] < 0.3


def test_a_place_is_not_taken_twice(refined: RefinedRig) -> None:
    rows = refined.matches[PAIR]
    for side, c in enumerate(PAIR):
        assert len(np.unique(rows[:, side])) == len(rows)
        assert len(refined.cameras[c].keypoints) == len(rows)


def test_a_camera_without_a_pose_takes_no_part(
    cameras: Mapping[int, ObservedCamera], regions: Regions
) -> None:
    alone = refine(cameras, regions, {0: poses_off()[0]}, NO_CORRECTION, PREDICTION_PX)
    assert alone.matches == {}
    assert all(len(camera.keypoints) == 0 for camera in alone.cameras.values())


def test_the_same_input_gives_the_same_bits(
    refined: RefinedRig, cameras: Mapping[int, ObservedCamera], regions: Regions
) -> None:
    again = refine(cameras, regions, poses_off(), NO_CORRECTION, PREDICTION_PX)
    for c in PAIR:
        a, b = refined.cameras[c].keypoints, again.cameras[c].keypoints
        assert a.pixels.tobytes() == b.pixels.tobytes()
        assert a.information.tobytes() == b.information.tobytes()


def test_a_pair_without_any_patch_keeps_its_keypoint_matches() -> None:
    """Synthetic cameras have blank images and depth at their keypoints only."""
    rig = SyntheticRig(cameras=2)
    cameras = {c: rig.observe(c, 0.25, 0.3) for c in PAIR}
    sides = {PAIR: (whole_image(MODEL.color), whole_image(MODEL.color))}
    matches = {PAIR: true_matches(cameras[0], cameras[1])}
    kept = refine(cameras, sides, rig.truth, NO_CORRECTION, PREDICTION_PX, frozenset(), matches)
    rows = kept.matches[PAIR]
    assert len(rows) == len(matches[PAIR]) > 20
    for side, c in enumerate(PAIR):
        before, after = matches[PAIR][:, side], rows[:, side]
        for name in ("pixels", "information"):
            old, new = (getattr(one[c].keypoints, name) for one in (cameras, kept.cameras))
            np.testing.assert_array_equal(new[after], old[before])
        np.testing.assert_array_equal(kept.cameras[c].points[after], cameras[c].points[before])
    without = refine(cameras, sides, rig.truth, NO_CORRECTION, PREDICTION_PX)
    assert len(without.matches[PAIR]) == 0


def test_keypoint_matches_do_not_join_a_pair_that_has_patches(
    refined: RefinedRig, cameras: Mapping[int, ObservedCamera], regions: Regions
) -> None:
    keypoints = {PAIR: np.array([[0, 0], [1, 1]])}
    found = refine(cameras, regions, poses_off(), NO_CORRECTION, PREDICTION_PX, frozenset(), keypoints)
    np.testing.assert_array_equal(found.matches[PAIR], refined.matches[PAIR])


def test_a_blank_image_leaves_depth_alone(cameras: Mapping[int, ObservedCamera], regions: Regions) -> None:
    blank = {c: replace(camera, image=np.full_like(camera.image, 90.0)) for c, camera in cameras.items()}
    found = refine(blank, regions, poses_off(), NO_CORRECTION, PREDICTION_PX)
    rows = found.matches[PAIR]
    both = np.column_stack([found.cameras[c].keypoints.has_place[rows[:, k]] for k, c in enumerate(PAIR)])
    assert len(rows) > 20
    assert (both.sum(axis=1) == 1).all()
