"""Which planes of different cameras are one wall, and what walls alone say about a rig."""

from collections.abc import Sequence

import numpy as np
import pytest

from rig_calib.joint_estimate import estimate_jointly
from rig_calib.observed_camera import ObservedCamera
from rig_calib.overlap import shared_regions
from rig_calib.rig_adjustment import AdjustedRig, adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_calib.shared_planes import SharedPlanes, find_shared_planes
from rig_calib.uncertainty import weakest_direction
from rig_protocol.poses import Pose, inverse, se3_exp, se3_log
from rig_protocol.rig_folder import RingDrawing
from support.flat_rooms import GRID, MODEL, Piece, Unit, box, inverse_depth, observed

RING = RingDrawing()
WELL_KNOWN = RingDrawing(tolerance_deg=0.05, tolerance_m=0.001)
SETTINGS = CalibrationSettings()
GOOD_DEPTH = CalibrationSettings(bias_scale_sigma=0.001, bias_shape_sigma=0.001)
MOUNTING = np.repeat([np.deg2rad(1.0), 0.005], 3)


def ring(slots: Sequence[int], rng: np.random.Generator | None = None) -> dict[int, Pose]:
    """True poses: the drawing's, off by how people mount cameras."""
    off = np.zeros((len(slots), 6)) if rng is None else MOUNTING * rng.standard_normal((len(slots), 6))
    return {c: RING.T_rig_camera(c) @ se3_exp(turn) for c, turn in zip(slots, off, strict=True)}


def cameras_in(
    pieces: dict[int, Sequence[Piece]], truth: dict[int, Pose], units: dict[int, Unit], seed: int
) -> dict[int, ObservedCamera]:
    rng = np.random.default_rng(seed)
    return {
        c: observed(
            c, units[c].disparity(inverse_depth(pieces[c], T @ GRID.T_color_grid), rng), RING.T_rig_camera(c)
        )
        for c, T in truth.items()
    }


def drawn(
    cameras: dict[int, ObservedCamera], known: RingDrawing, settings: CalibrationSettings
) -> AdjustedRig:
    """What is known of a rig before anything is measured."""
    return adjust_rig(cameras, {}, {c: RING.T_rig_camera(c) for c in cameras}, known, settings)


def shared_in(
    pieces: dict[int, Sequence[Piece]],
    known: RingDrawing = WELL_KNOWN,
    settings: CalibrationSettings = GOOD_DEPTH,
) -> SharedPlanes:
    truth = ring(tuple(pieces))
    rig = drawn(cameras_in(pieces, truth, dict.fromkeys(pieces, Unit()), 3), known, settings)
    cameras = cameras_in(pieces, truth, dict.fromkeys(pieces, Unit()), 3)
    return find_shared_planes(cameras, rig.scene.cameras, rig.adjustment)


def cameras_of(shared: SharedPlanes) -> list[set[int]]:
    return [set(shared.seen.camera[shared.seen.plane == k].tolist()) for k in range(len(shared.planes))]


def wall(distance_m: float, low: float = -np.inf, high: float = np.inf) -> Piece:
    """A wall that faces slot 0, between two places to its left."""
    return Piece(np.array([1.0 / distance_m, 0, 0]), np.array([-9.0, low, -9.0]), np.array([9.0, high, 9.0]))


def test_neighbours_share_the_wall_that_both_see() -> None:
    shared = shared_in({0: [wall(2.0)], 1: [wall(2.0)]})
    assert cameras_of(shared) == [{0, 1}]
    np.testing.assert_allclose(shared.planes, [[0.5, 0, 0]], atol=0.004)


def test_what_one_camera_alone_sees_is_no_landmark() -> None:
    corner = [wall(2.0), Piece(np.array([0.0, 1 / 1.6, 0.0]))]
    shared = shared_in({0: [wall(2.0)], 1: corner})
    assert cameras_of(shared) == [{0, 1}]
    assert shared.seen.camera.max() == 1


@pytest.mark.parametrize("gap_m", [0.05, 0.1])
def test_parallel_walls_that_are_told_apart_are_not_merged(gap_m: float) -> None:
    assert not len(shared_in({0: [wall(2.0)], 1: [wall(2.0 - gap_m)]}).planes)


def test_of_two_parallel_walls_that_each_could_be_meant_none_is_shared() -> None:
    """A niche as deep as what depth may be off: each camera sees its wall and its bottom."""
    niche = [wall(2.0, high=0.4), wall(2.06, low=0.4, high=0.75), wall(2.0, low=0.75)]
    known, vague = shared_in({0: niche, 1: niche}), shared_in({0: niche, 1: niche}, RING, SETTINGS)
    np.testing.assert_allclose(sorted(1 / np.linalg.norm(known.planes, axis=1)), [2.0, 2.06], atol=0.01)
    assert not len(vague.planes)


def test_parallel_walls_that_could_be_one_are_not_merged_where_no_camera_sees_both_in_one_place() -> None:
    """A door stands 4 cm off its wall, as much as a unit's depth is off; the cameras look past each other."""
    left = [wall(2.0, high=0.3)]
    assert not len(shared_in({0: left, 1: [wall(1.96, low=0.6)]}, RING, SETTINGS).planes)
    assert not len(shared_in({0: left, 1: [wall(2.0, low=0.6)]}, RING, SETTINGS).planes)
    assert len(shared_in({0: left, 1: [wall(2.0, low=0.6)]}).planes) == 1
    assert len(shared_in({0: [wall(2.0)], 1: [wall(2.0)]}, RING, SETTINGS).planes) == 1


def test_walls_that_several_cameras_see_are_one_landmark() -> None:
    room = box((2.0, 1.8, 0.7))
    shared = shared_in(dict.fromkeys((0, 1, 2, 3), room))
    groups = cameras_of(shared)
    assert max(map(len, groups)) >= 3
    truth = np.array([piece.plane for piece in room])
    for plane in shared.planes:
        assert np.linalg.norm(truth - plane, axis=1).min() < 0.01


def test_a_rig_without_depth_shares_nothing() -> None:
    nothing: dict[int, Sequence[Piece]] = {0: [], 1: []}
    shared = shared_in(nothing)
    assert shared.planes.shape == (0, 3)
    assert not len(shared.seen)


def test_neighbours_in_an_image_do_not_count_as_if_they_knew_more_than_one() -> None:
    """What a plane says depends on its extent, and hardly on how many pixels it has."""
    room: dict[int, Sequence[Piece]] = {0: [wall(2.0)], 1: [wall(2.0)]}
    seen = shared_in(room).seen
    information = (1 / seen.disparity_sigma[seen.camera == 0] ** 2).sum()
    per_area = (640 / 55) * (480 / 55) / (2 * np.pi)  # windows of one distortion
    assert information < 2.0 * per_area / (0.002 * 174) ** 2


def test_a_bare_room_narrows_the_drawing_and_its_covariance_holds() -> None:
    """Walls alone, no texture, units with all their faults: what is left is no more than σ says."""
    errors, gained = [], []
    room, slots = box((2.0, 1.8, 0.7)), (0, 1, 2, 3)
    for seed in range(8):
        rng = np.random.default_rng([seed, 11])
        truth = ring(slots, rng)
        units = {c: Unit(0.01 * rng.standard_normal(), 0.023) for c in slots}
        cameras = cameras_in(dict.fromkeys(slots, room), truth, units, seed)
        before = drawn(cameras, RING, SETTINGS)
        shared = find_shared_planes(cameras, before.scene.cameras, before.adjustment)
        after = adjust_rig(cameras, {}, before.poses, RING, SETTINGS, shared=shared)
        for i, j in ((0, 1), (1, 2), (2, 3)):
            T, covariance = after.relative(i, j)
            error = se3_log(inverse(T) @ inverse(truth[i]) @ truth[j])
            errors.append(error @ np.linalg.solve(covariance, error) / 6)
            gained.append(np.trace(covariance[:3, :3]) / np.trace(before.relative(i, j)[1][:3, :3]))
        assert weakest_direction(after.covariance_of(1))[1] < 0.01
    # 24 pairs of 6 degrees of freedom, correlated within a rig: 99.9 % below 1.45 if σ is honest.
    assert 0.2 < np.mean(errors) < 1.45
    assert np.mean(gained) < 0.5


def test_walls_turn_a_camera_right_where_depth_has_no_bias() -> None:
    """A third of a degree, where the drawing leaves two or more; what is left is as large as σ says."""
    room, slots = box((2.0, 1.8, 0.7)), (0, 1)
    truth = ring(slots, np.random.default_rng(5))
    cameras = cameras_in(dict.fromkeys(slots, room), truth, dict.fromkeys(slots, Unit()), 5)
    before = drawn(cameras, RING, GOOD_DEPTH)
    shared = find_shared_planes(cameras, before.scene.cameras, before.adjustment)
    after = adjust_rig(cameras, {}, before.poses, RING, GOOD_DEPTH, shared=shared)
    T, covariance = after.relative(0, 1)
    error = se3_log(inverse(T) @ inverse(truth[0]) @ truth[1])
    unmoved = se3_log(inverse(before.relative(0, 1)[0]) @ inverse(truth[0]) @ truth[1])
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.3
    assert np.linalg.norm(error[:3]) < 0.3 * np.linalg.norm(unmoved[:3])
    assert error @ np.linalg.solve(covariance, error) / 6 < 3.0


@pytest.mark.parametrize(("known", "needed"), [(RING, True), (WELL_KNOWN, False)])
def test_planes_join_where_a_pair_is_known_too_little_for_the_gate_and_nowhere_else(
    known: RingDrawing, needed: bool
) -> None:
    slots = (0, 1)
    room = dict.fromkeys(slots, box((2.0, 1.8, 0.7)))
    cameras = cameras_in(room, ring(slots), dict.fromkeys(slots, Unit()), 7)
    nominal = {c: RING.T_rig_camera(c) for c in slots}
    regions = shared_regions(dict.fromkeys(slots, MODEL.color), dict(nominal), 7.0)
    estimate = estimate_jointly(cameras, regions, (), nominal, known, SETTINGS)
    assert estimate is not None
    assert bool(len(estimate.rig.adjustment.planes)) == needed
