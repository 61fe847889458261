"""Errors against the truth do not depend on the frame and name what is missing."""

import numpy as np
import pytest

from rig_calib.evaluation import evaluate
from rig_protocol.errors import DataError
from rig_protocol.poses import Pose, se3_exp
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
