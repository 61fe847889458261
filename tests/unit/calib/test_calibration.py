"""The whole pipeline on synthetic keypoints: knocks, absences, determinism, what the gate says."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rig_calib import calibration as pipeline
from rig_calib.calibration import CalibrationResult, calibrate
from rig_calib.evaluation import evaluate
from rig_calib.observed_camera import ObservedCamera
from rig_calib.settings import CalibrationSettings
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, se3_exp, transform_points
from support.synthetic_rig import SyntheticCamera, SyntheticRig

SETTINGS = CalibrationSettings()
Calibrate = Callable[..., CalibrationResult]


@pytest.fixture
def solve(monkeypatch: pytest.MonkeyPatch) -> Calibrate:
    """Calibrates a synthetic rig: its keypoints take the place of detected ones."""

    def run(
        rig: SyntheticRig,
        views: list[CameraView] | None = None,
        settings: CalibrationSettings = SETTINGS,
        drawn: bool = True,
        change: Callable[[SyntheticCamera], SyntheticCamera] = lambda camera: camera,
        **options: object,
    ) -> CalibrationResult:
        def observe(view: CameraView, *_: object) -> ObservedCamera:
            seen = rig.observe(view.camera_id, pixel_sigma=0.25, disparity_sigma=0.3, drawn=drawn)
            return change(replace(seen, view=view))

        monkeypatch.setattr(pipeline, "observe", observe)
        ring = rig.drawing if drawn else None
        return calibrate(views or rig.views(drawn), ring, settings, **options)

    return run


def blind(*camera_ids: int) -> Callable[[SyntheticCamera], SyntheticCamera]:
    """Keypoints of these cameras look like nothing that another camera sees."""

    def change(camera: SyntheticCamera) -> SyntheticCamera:
        if camera.view.camera_id not in camera_ids:
            return camera
        rng = np.random.default_rng(camera.view.camera_id)
        keypoints = camera.keypoints
        other = rng.uniform(0, 60, keypoints.descriptors.shape).astype(np.float32)
        return replace(camera, keypoints=replace(keypoints, descriptors=other))

    return change


def depthless(camera_id: int) -> Callable[[SyntheticCamera], SyntheticCamera]:
    """This camera delivers colour only."""
    return lambda camera: camera.without_depth() if camera.view.camera_id == camera_id else camera


def hide_overlap(rig: SyntheticRig, azimuth_deg: float) -> None:
    """Take away what is seen around a direction from the rig's middle."""
    middle = np.arctan2(rig.world[:, 1], rig.world[:, 0])
    off = np.abs((middle - np.deg2rad(azimuth_deg) + np.pi) % (2 * np.pi) - np.pi)
    rig.world[off < np.deg2rad(14.0)] = (0.0, 0.0, 9.0)


def nominal_poses(rig: SyntheticRig) -> dict[int, Pose]:
    return {c: rig.drawing.T_rig_camera(c) for c in range(rig.cameras)}


def test_a_ring_is_calibrated_in_its_drawings_frame(solve: Calibrate) -> None:
    rig = SyntheticRig(bias=0.01)
    result = solve(rig)
    calibration = result.calibration
    errors = evaluate(calibration, rig.truth)
    summary = errors.over(errors.neighbours)
    assert summary is not None
    assert summary.count == 12
    assert summary.mean.deg < 0.1
    assert summary.mean.mm < 4.0
    assert calibration.failures == ()
    assert calibration.rig_frame == "ring"
    assert all(camera.covariance is not None for camera in calibration.cameras)
    assert {edge.used for edge in calibration.edges} == {True}
    consistency = errors.consistency()  # neighbours and aligned cameras have covariances of their own
    assert {name: known.count for name, known in consistency.items()} == {"pairs": 12, "cameras": 12}
    assert all(known.nees < 2.0 for known in consistency.values())
    assert all(len(item.pixel_errors) > len(item.disparity_errors) > 0 for item in result.evidence)
    assert len(result.evidence) == 12
    assert result.poses_before.keys() == rig.truth.keys()


def test_the_papers_method_calibrates_and_closes_the_loop(solve: Calibrate) -> None:
    rig = SyntheticRig()
    calibration = solve(rig, settings=SETTINGS.model_copy(update={"method": "paper"})).calibration
    absolute = evaluate(calibration, rig.truth).absolute
    assert absolute is not None
    assert absolute.mean.deg < 0.5
    assert absolute.mean.mm < 15.0
    loop = calibration.loop_closure
    assert loop is not None
    assert loop.before_deg > 0.01
    assert loop.after_deg < 1e-6
    assert calibration.method == "paper"
    assert all(edge.relative_covariance is None for edge in calibration.edges)
    assert all(camera.aligned_covariance is None for camera in calibration.cameras)


def test_a_knocked_camera_is_found_from_its_matches(solve: Calibrate) -> None:
    """4 degrees and 3 cm out of place: calibrated, warned about, and nobody is worse than the drawing."""
    rig = SyntheticRig()
    knock = np.array([0.0, np.deg2rad(4.0), 0.0, 0.03, 0.0, 0.0])
    rig.truth[5] = rig.truth[5] @ se3_exp(knock)
    calibration = solve(rig).calibration
    errors, drawing = (evaluate(poses, rig.truth) for poses in (calibration.poses, nominal_poses(rig)))
    assert errors.cameras[5].deg < 0.15
    assert errors.cameras[5].mm < 5.0
    assert errors.absolute is not None
    assert drawing.absolute is not None
    assert errors.absolute.mean.deg < drawing.absolute.mean.deg
    assert errors.absolute.mean.mm < drawing.absolute.mean.mm
    assert any("camera 5" in warning and "drawing" in warning for warning in calibration.warnings)


def test_a_rig_without_a_drawing_is_calibrated_relative_to_camera_0(solve: Calibrate) -> None:
    rig = SyntheticRig(cameras=6)
    calibration = solve(rig, drawn=False).calibration
    errors = evaluate(calibration, rig.truth).absolute
    assert errors is not None
    assert errors.max.deg < 0.2
    assert len(calibration.edges) == 15
    assert calibration.rig_frame == "camera 0"
    assert np.array_equal(calibration.cameras[0].T_rig_camera, np.eye(4))
    assert not np.any(calibration.cameras[0].covariance)


def test_gravity_is_weighed_as_its_view_says_and_the_calibration_tells_who_felt_it(
    solve: Calibrate,
) -> None:
    """A camera that nobody matches: its mount leaves its tilt open, its accelerometer says it."""
    rig = SyntheticRig(cameras=4)
    down = np.array([0.0, 0.0, -1.0])

    def felt(sigma_deg: float) -> CalibrationResult:
        views = [
            replace(view, gravity=rig.truth[c][:3, :3].T @ down, gravity_sigma_deg=sigma_deg)
            for c, view in enumerate(rig.views())
        ]
        return solve(rig, views, change=blind(3))

    silent, vague, sure = solve(rig, change=blind(3)), felt(10.0), felt(0.05)
    assert "gravity_cameras" not in silent.calibration.provenance
    assert sure.calibration.provenance["gravity_cameras"] == [0, 1, 2, 3]
    tilts = [_tilt_sigma_deg(result, 3) for result in (silent, vague, sure)]
    assert tilts[1] > 0.95 * tilts[0]
    assert tilts[2] < 0.5 * tilts[0]


def _tilt_sigma_deg(result: CalibrationResult, camera: int) -> float:
    """About the optical axis, which lies level: relative to camera 0's frame, so that only tilt counts."""
    assert result.rig is not None
    return float(np.rad2deg(np.sqrt(result.rig.relative(0, camera)[1][2, 2])))


def test_the_papers_method_tells_of_no_gravity(solve: Calibrate) -> None:
    rig = SyntheticRig(cameras=3)
    views = [replace(view, gravity=np.array([1.0, 0.0, 0.0])) for view in rig.views()]
    calibration = solve(rig, views, SETTINGS.model_copy(update={"method": "paper"})).calibration
    assert "gravity_cameras" not in calibration.provenance


def test_the_same_input_gives_bit_identical_cameras_and_edges(solve: Calibrate) -> None:
    rig = SyntheticRig(cameras=4)
    first, second = (solve(rig).calibration.to_dict() for _ in range(2))
    assert first["cameras"] == second["cameras"]
    assert first["edges"] == second["edges"]


def test_a_camera_without_images_fails_and_the_others_are_solved(solve: Calibrate) -> None:
    rig = SyntheticRig()
    views = rig.views()
    views[3] = replace(views[3], color=())
    calibration = solve(rig, views).calibration
    assert len(calibration.failures) == 1
    assert "camera 3 (cam03)" in calibration.failures[0]
    assert "no colour image" in calibration.failures[0]
    assert sorted(calibration.poses) == [c for c in range(12) if c != 3]


def test_a_camera_without_depth_is_placed_by_its_neighbours_depth(solve: Calibrate) -> None:
    rig = SyntheticRig()
    calibration = solve(rig, change=depthless(3)).calibration
    assert calibration.failures == ()
    errors = evaluate(calibration, rig.truth)
    for pair in ((2, 3), (3, 4)):
        assert errors.pairs[pair].deg < 0.15
        assert errors.pairs[pair].mm < 5.0


def test_without_a_drawing_a_camera_that_matches_nobody_is_named_with_its_best_partner(
    solve: Calibrate,
) -> None:
    rig = SyntheticRig(cameras=6)
    calibration = solve(rig, change=blind(5), drawn=False).calibration
    failure = next(text for text in calibration.failures if "camera 5" in text)
    assert "not connected" in failure
    assert "patterns" in failure
    assert calibration.camera(5) is None
    assert len(calibration.cameras) == 5


def test_with_a_drawing_a_camera_that_matches_nobody_is_as_uncertain_as_its_mount(solve: Calibrate) -> None:
    """It fails the gate, both of its edges are named, and its covariance claims the drawing's tolerance."""
    rig = SyntheticRig()
    calibration = solve(rig, change=blind(8)).calibration
    assert len(calibration.failures) == 2
    for failure, edge in zip(calibration.failures, ("edge 7–8", "edge 8–9"), strict=True):
        assert edge in failure
        assert "patterns" in failure
    unseen = calibration.camera(8)
    assert unseen is not None
    assert unseen.covariance is not None
    mount_sigma = np.repeat([np.deg2rad(rig.drawing.tolerance_deg), rig.drawing.tolerance_m], 3)
    np.testing.assert_allclose(np.sqrt(np.diag(unseen.covariance)), mount_sigma, rtol=0.05)
    others = [camera for camera in calibration.cameras if camera.id != 8]
    assert len(others) == 11
    rotation = slice(0, 3)
    assert all(np.sqrt(np.diag(c.covariance)[rotation]).max() < 0.5 * mount_sigma[0] for c in others)


def test_a_missing_overlap_is_warned_about_while_the_other_way_round_holds(solve: Calibrate) -> None:
    rig = SyntheticRig()
    hide_overlap(rig, 75.0)  # between cameras 2 and 3
    calibration = solve(rig).calibration
    assert calibration.failures == ()
    assert any("edge 2–3: of 0 matches" in warning for warning in calibration.warnings)
    assert any("no loop confirms" in warning for warning in calibration.warnings)
    assert len(calibration.cameras) == 12


def test_two_broken_overlaps_leave_two_chains_placed_each_well_and_apart_as_the_drawing_allows(
    solve: Calibrate,
) -> None:
    rig = SyntheticRig()
    hide_overlap(rig, 75.0)  # between cameras 2 and 3
    hide_overlap(rig, 255.0)  # between cameras 8 and 9
    calibration = solve(rig).calibration
    assert len(calibration.cameras) == 12
    assert {"2–3", "8–9"} == {failure.split("edge ")[1][:3] for failure in calibration.failures}
    errors = evaluate(calibration, rig.truth).pairs
    sigma_deg = {
        (edge.i, edge.j): np.rad2deg(np.sqrt(np.diag(edge.relative_covariance)[:3].max()))
        for edge in calibration.edges
        if edge.relative_covariance is not None
    }
    within, across = (4, 5), (2, 3)
    assert errors[within].deg < 0.2
    assert sigma_deg[within] < 0.2 < sigma_deg[across] < rig.drawing.tolerance_deg
    assert errors[across].deg < 4.0 * sigma_deg[across]


def test_a_plausible_false_edge_is_dropped_with_a_reason(solve: Calibrate) -> None:
    """What cameras 2 and 3 share hangs elsewhere for camera 3: the edge is perfect in itself, and false."""
    rig, elsewhere = SyntheticRig(), SyntheticRig()
    azimuth = np.arctan2(rig.world[:, 1], rig.world[:, 0])
    shared = np.abs(azimuth - np.deg2rad(75.0)) < np.deg2rad(14.0)
    turn = se3_exp(np.array([0.0, 0.0, np.deg2rad(6.0), 0.0, 0.0, 0.0]))
    elsewhere.world[shared] = transform_points(turn, rig.world[shared])

    def change(camera: SyntheticCamera) -> SyntheticCamera:
        if camera.view.camera_id != 3:
            return camera
        return elsewhere.observe(3, pixel_sigma=0.25, disparity_sigma=0.3)

    calibration = solve(rig, change=change).calibration
    false = next(edge for edge in calibration.edges if (edge.i, edge.j) == (2, 3))
    assert false.reason is not None
    assert false.reason.startswith("contradicts")
    assert not false.used
    assert calibration.failures == ()
    assert evaluate(calibration, rig.truth).pairs[2, 3].deg < 0.5


def test_no_images_at_all_is_a_result_that_failed(solve: Calibrate) -> None:
    rig = SyntheticRig(cameras=3)
    views = [replace(view, color=(), raw=()) for view in rig.views()]
    calibration = solve(rig, views).calibration
    assert calibration.cameras == ()
    assert len(calibration.failures) == 3


def test_progress_never_runs_backwards_and_every_stage_is_timed(solve: Calibrate) -> None:
    told: list[tuple[str, float]] = []
    rig = SyntheticRig(cameras=3)
    result = solve(rig, progress=lambda stage, share: told.append((stage, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    assert list(result.calibration.seconds) == [
        "load",
        "features",
        "matching",
        "registration",
        "optimisation",
        "total",
    ]
