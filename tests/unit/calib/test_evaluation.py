"""Errors against the truth do not depend on the frame and name what is missing."""

import numpy as np
import pytest

from rig_calib.evaluation import evaluate
from rig_calib.normalised_error import Consistency, normalised_error
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, RigCalibration
from rig_calib.uncertainty import PoseCovariance
from rig_protocol.errors import DataError
from rig_protocol.poses import Pose, inverse, se3_exp
from rig_protocol.rig_folder import RingDrawing

TRUTH: dict[int, Pose] = {c: RingDrawing().T_rig_camera(c) for c in range(12)}
ELSEWHERE = se3_exp(np.array([0.3, -0.2, 1.0, 2.0, 1.0, 0.5]))


def test_a_perfect_calibration_in_another_frame_has_no_error() -> None:
    errors = evaluate({c: ELSEWHERE @ T for c, T in TRUTH.items()}, TRUTH)
    for summary in errors.summaries().values():
        assert summary.max.deg < 1e-5
        assert summary.max.mm < 1e-6


def test_one_turned_camera_shows_in_its_two_pairs() -> None:
    turned = TRUTH | {4: TRUTH[4] @ se3_exp(np.array([0.0, np.deg2rad(1.2), 0, 0.006, 0, 0]))}
    errors = evaluate(turned, TRUTH)
    wrong = {pair for pair in errors.neighbours if errors.pairs[pair].deg > 0.1}
    assert wrong == {(3, 4), (4, 5)}
    assert errors.pairs[4, 5].deg == pytest.approx(1.2)
    neighbours = errors.over(errors.neighbours)
    assert neighbours is not None
    assert neighbours.count == 12
    assert neighbours.mean.deg == pytest.approx(0.2)
    assert neighbours.median.deg == pytest.approx(0.0, abs=1e-6)
    assert errors.cameras[4].deg > 10 * errors.cameras[0].deg


def test_an_open_arc_has_no_pair_of_its_ends() -> None:
    arc = {c: T for c, T in TRUTH.items() if c < 5}
    assert evaluate(arc, arc).neighbours == ((0, 1), (1, 2), (2, 3), (3, 4))


def test_a_missing_camera_is_named_and_not_averaged() -> None:
    errors = evaluate({c: T for c, T in TRUTH.items() if c != 7}, TRUTH)
    assert errors.missing == (7,)
    assert len(errors.neighbours) == 10
    assert errors.to_dict()["missing"] == [7]


def test_rigs_without_a_common_camera_are_refused() -> None:
    with pytest.raises(DataError, match="no camera in common"):
        evaluate({20: np.eye(4)}, TRUTH)


def drawn_rig(seed: int, promised: float = 1.0) -> tuple[RigCalibration, dict[int, Pose]]:
    """A calibration with independent errors, whose covariances are `promised` times the true ones."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([1e-3, 2e-3], 3)
    estimated = {c: T @ se3_exp(sigma * rng.standard_normal(6)) for c, T in TRUTH.items()}
    joint = np.diag(np.tile(promised * sigma**2, 12)).reshape(12, 6, 12, 6)
    known = PoseCovariance(joint)
    aligned = known.aligned(list(estimated.values()))
    relative = {c: inverse(estimated[c]) @ estimated[(c + 1) % 12] for c in TRUTH}
    calibration = RigCalibration(
        method="joint",
        rig_frame="ring",
        cameras=tuple(
            CalibratedCamera(c, f"cam{c:02d}", T, known.of(c), aligned_covariance=aligned.of(c))
            for c, T in estimated.items()
        ),
        edges=tuple(
            CalibratedEdge(c, d, 9, 9, 1.0, T, True, None, known.relative(c, d, T))
            for c, T in relative.items()
            for d in [(c + 1) % 12]
        ),
        loop_closure=None,
        seconds={},
        frames_used=1,
    )
    return calibration, TRUTH


def test_normalised_errors_are_one_on_the_mean_when_the_covariance_is_true() -> None:
    """100 rigs: 72 degrees of freedom each leave 0.02; the cameras' common motion is six of them."""
    rigs = [evaluate(*drawn_rig(seed)).consistency() for seed in range(100)]
    assert np.mean([rig["pairs"].nees for rig in rigs]) == pytest.approx(1.0, abs=0.06)
    assert np.mean([rig["cameras"].nees for rig in rigs]) == pytest.approx(1.0, abs=0.06)
    assert rigs[0]["pairs"].count == 12


def test_a_covariance_that_promises_too_much_shows() -> None:
    bold = evaluate(*drawn_rig(0, promised=0.25)).consistency()["pairs"]
    assert bold.nees > bold.high
    assert bold.low < 1.0 < bold.high


def test_normalised_errors_are_in_the_json_by_pair_and_by_camera() -> None:
    values = evaluate(*drawn_rig(0)).to_dict()
    assert all(edge["nees"] > 0 for edge in values["edges"])
    assert all(camera["nees"] > 0 for camera in values["cameras"])
    mean = np.mean([edge["nees"] for edge in values["edges"]])
    assert values["consistency"]["pairs"] == {
        "count": 12,
        "nees": pytest.approx(mean),
        "low": pytest.approx(0.70, abs=0.01),
        "high": pytest.approx(1.35, abs=0.01),
    }


def test_without_covariances_nothing_is_said_of_consistency() -> None:
    bare = evaluate(TRUTH, TRUTH)
    assert bare.consistency() == {}
    assert bare.to_dict()["edges"][0]["nees"] is None
    assert Consistency.of([]) is None


def test_cameras_are_not_judged_when_the_truth_lacks_one() -> None:
    """Their covariance is of an alignment over all of them."""
    calibration, truth = drawn_rig(0)
    some = {c: T for c, T in truth.items() if c != 5}
    known = evaluate(calibration, some).consistency()
    assert "cameras" not in known
    assert known["pairs"].count == 10


def test_a_pose_that_defines_the_frame_has_no_normalised_error() -> None:
    assert normalised_error(np.eye(4), np.eye(4), np.zeros((6, 6))) is None
    assert normalised_error(np.eye(4), np.eye(4), None) is None
