"""What the coach says: states of overlaps, what to do, and whether a target is met."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib.accuracy import Accuracy, AccuracyTarget
from rig_calib.coaching import PairSupport, Support, pair_supports, shortfall
from rig_calib.overlap import Region
from rig_calib.overlap_survey import survey
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, RigCalibration
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel
from rig_protocol.rig_folder import RingDrawing

DRAWING = RingDrawing()
GREY = np.full((480, 640), 120, np.uint8)
TWO_METRES, NEAR, NOTHING = 916, 500, 2047  # raw disparity; 500 is 0.59 m


def view(camera: int, grey: int = 120, raw: int = TWO_METRES, drawn: bool = True) -> CameraView:
    return CameraView(
        camera,
        f"cam{camera:02d}",
        CameraModel(),
        (np.full((480, 640), grey, np.uint8),),
        raw=(np.full((480, 640), raw, np.uint16),),
        T_rig_nominal=DRAWING.T_rig_camera(camera) if drawn else None,
    )


def edge(
    i: int, j: int, matches: int = 200, reason: str | None = None, rms_mm: float = 12.0
) -> CalibratedEdge:
    return CalibratedEdge(i, j, matches, matches, rms_mm, np.eye(4), reason is None, reason)


def calibration(count: int, *edges: CalibratedEdge, mm: float = 1.0) -> RigCalibration:
    """Every camera errs by `mm` millimetres and `mm`/50 degrees on each axis, on its own."""
    cameras = tuple(CalibratedCamera(i, f"cam{i:02d}", DRAWING.T_rig_camera(i)) for i in range(count))
    sigma = np.tile(np.repeat([np.deg2rad(mm / 50), mm * 1e-3], 3), count)
    return RigCalibration("joint", "ring", cameras, edges, None, {}, 1, joint_covariance=np.diag(sigma**2))


def test_the_expected_error_is_the_root_mean_square_of_what_a_covariance_describes() -> None:
    sigma = np.array([0.001, 0.002, 0.003, 0.004, 0.005, 0.006])
    errors = np.random.default_rng(0).standard_normal((20_000, 6)) * sigma
    expected = Accuracy.of(np.diag(sigma**2))
    square = np.mean(errors**2, axis=0)
    assert expected.deg == pytest.approx(np.rad2deg(np.sqrt(square[:3].sum())), rel=0.02)
    assert expected.mm == pytest.approx(1e3 * np.sqrt(square[3:].sum()), rel=0.02)


def test_overlaps_are_those_of_the_drawing_and_good_ones_need_no_advice() -> None:
    known = calibration(4, edge(0, 1), edge(1, 2), edge(2, 3))
    pairs = pair_supports(known, [view(i) for i in range(4)])
    assert [(pair.i, pair.j, pair.support, pair.advice) for pair in pairs] == [
        (0, 1, Support.GOOD, None),
        (1, 2, Support.GOOD, None),
        (2, 3, Support.GOOD, None),
    ]
    assert pair_supports(known, [view(i) for i in range(4)], of_camera=3) == pairs[2:]


def test_a_bare_overlap_is_told_with_its_matches_its_expected_error_and_where_to_hang_a_pattern() -> None:
    refused = edge(1, 2, 6, "of 30 matches fewer than 8 agree on one pose", rms_mm=0.0)
    pairs = pair_supports(calibration(3, edge(0, 1), refused, mm=5.0), [view(i) for i in range(3)])
    assert pairs[1].support is Support.NOTHING
    told = str(pairs[1])
    assert told.startswith("overlap cam01–cam02: 6 matches, ±0.24° ±12 mm: hang a pattern where both look")


def test_an_overlap_that_was_never_a_candidate_is_bare_too() -> None:
    pairs = pair_supports(calibration(3, edge(0, 1)), [view(i) for i in range(3)])
    assert (pairs[1].i, pairs[1].j, pairs[1].matches, pairs[1].support) == (1, 2, 0, Support.NOTHING)


def test_matches_on_a_line_are_weak_and_the_reason_is_told() -> None:
    weak = edge(0, 1, 40, "the matches leave a direction open (standard deviation 2.0°, 90 mm)")
    (pair,) = pair_supports(calibration(2, weak), [view(0), view(1)])
    assert pair.support is Support.WEAK
    assert pair.advice is not None
    assert "leave a direction open" in pair.advice
    assert "spread patterns" in pair.advice


def test_a_used_edge_that_is_expected_to_be_poor_is_weak() -> None:
    (pair,) = pair_supports(calibration(2, edge(0, 1), mm=10.0), [view(0), view(1)])
    assert (pair.support, pair.used) == (Support.WEAK, True)


def test_a_target_takes_the_place_of_the_ordinary_limit() -> None:
    views, known = [view(0), view(1)], calibration(2, edge(0, 1), mm=1.0)  # 2.4 mm, 0.05°
    states = [
        pair_supports(known, views, AccuracyTarget(deg, mm))[0].support
        for deg, mm in ((None, 3.0), (None, 2.0), (0.06, None), (0.04, 3.0))
    ]
    assert states == [Support.GOOD, Support.WEAK, Support.GOOD, Support.WEAK]


@pytest.mark.parametrize(
    ("left", "right", "told"),
    [
        ({}, {"raw": NOTHING}, "cam01 delivers no depth there: move what stands closer than 0.5 m"),
        ({"raw": NEAR}, {}, "something 0.6 m in front of cam00 hides what cam01 sees: move it"),
        ({"grey": 3}, {}, "cam00 sees only darkness there"),
        ({}, {"grey": 250}, "cam01 is dazzled there"),
        ({}, {}, "hang a pattern where both look"),
    ],
)
def test_what_the_cameras_deliver_there_says_why_they_share_nothing(
    left: dict[str, int], right: dict[str, int], told: str
) -> None:
    (pair,) = pair_supports(calibration(2), [view(0, **left), view(1, **right)])
    assert pair.advice is not None
    assert told in pair.advice


def test_a_camera_that_delivers_nothing_is_named() -> None:
    (pair,) = pair_supports(calibration(2), [view(0), replace(view(1), raw=())])
    assert pair.advice is not None
    assert "cam01 delivers no depth image: see that it streams" in pair.advice


def test_a_box_before_one_part_of_the_image_does_not_touch_the_overlap_elsewhere() -> None:
    raw = np.full((480, 640), TWO_METRES, np.uint16)
    raw[:240] = NOTHING
    half = replace(view(0), raw=(raw,))
    assert survey(half, Region(0, 0, 640, 240)).depth_share == 0.0
    assert survey(half, Region(0, 240, 640, 480)).depth_share == 1.0


def test_without_a_drawing_used_edges_and_the_best_edge_of_a_lonely_camera_are_shown() -> None:
    """Every pair is a candidate then, and most of them look into different directions."""
    refused = [edge(i, 3, matches, "of few matches", 0.0) for i, matches in ((0, 2), (1, 5), (2, 3))]
    views = [view(i, drawn=False) for i in range(4)]
    pairs = pair_supports(calibration(4, edge(0, 1), edge(1, 2), *refused), views)
    assert [(pair.i, pair.j) for pair in pairs] == [(0, 1), (1, 2), (1, 3)]


def test_without_a_covariance_used_edges_are_good_and_nothing_is_expected() -> None:
    known = replace(calibration(2, edge(0, 1)), joint_covariance=None)
    (pair,) = pair_supports(known, [view(0), view(1)])
    assert (pair.support, pair.expected) == (Support.GOOD, None)
    assert "covariance" in (shortfall([pair], AccuracyTarget(mm=3.0)) or "")


def support(name: str, deg: float, mm: float, used: bool = True) -> PairSupport:
    return PairSupport(0, 1, name, 100, used, Accuracy(deg, mm), Support.GOOD)


def test_a_target_is_met_when_every_used_pair_meets_it() -> None:
    pairs = [support("a–b", 0.1, 3.0), support("b–c", 0.08, 2.0), support("c–d", 0.9, 30.0, used=False)]
    assert shortfall(pairs, AccuracyTarget(0.1, 3.0)) is None
    assert shortfall(pairs, AccuracyTarget(None, 3.0)) is None


def test_a_missed_target_says_which_pair_limits_and_by_how_much() -> None:
    pairs = [support("a–b", 0.125, 3.0), support("b–c", 0.08, 4.5)]
    told = shortfall(pairs, AccuracyTarget(0.1, 3.0))
    assert told == (
        "a–b limits: 0.125° expected, 0.1° wanted, 0.025° too much and "
        "b–c limits: 4.5 mm expected, 3 mm wanted, 1.5 mm too much"
    )


def test_nothing_meets_no_target() -> None:
    assert shortfall([], AccuracyTarget(mm=100.0)) == "no pair of cameras has support yet"
