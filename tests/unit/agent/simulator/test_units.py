"""Rules of the virtual units: what they tell is slightly wrong, by what real units are wrong."""

import numpy as np
import pytest

from rig_agent.simulator.settings import Knock, SimulatorSettings
from rig_agent.simulator.units import draw_T_rig_camera, draw_unit, ring_drawing
from rig_protocol.poses import inverse, rotation_angle_deg, se3_log

SETTINGS = SimulatorSettings(cameras=64)
UNITS = [draw_unit(SETTINGS, camera) for camera in range(64)]


def test_a_unit_tells_factory_values_and_keeps_the_truth() -> None:
    assert all(unit.factory.source == "factory" for unit in UNITS)
    assert all(unit.factory.color != unit.color for unit in UNITS)
    assert len({unit.factory.color for unit in UNITS}) == 64


def test_factory_intrinsics_are_off_by_the_stated_amounts() -> None:
    told = [camera for unit in UNITS for camera in (unit.factory.color, unit.factory.depth) if camera]
    true = [camera for unit in UNITS for camera in (unit.color, unit.depth)]
    focal = [t.fx / f.fx - 1 for t, f in zip(true, told, strict=True)]
    centre = [t.cx - f.cx for t, f in zip(true, told, strict=True)]
    assert np.std(focal) == pytest.approx(0.001, rel=0.25)
    assert np.std(centre) == pytest.approx(0.6, rel=0.25)


def test_factory_extrinsics_are_off_by_the_stated_amounts() -> None:
    errors = np.array(
        [se3_log(inverse(u.factory.T_color_depth) @ u.T_color_depth) for u in UNITS]  # type: ignore[arg-type]  # simulated units have depth
    )
    assert np.rad2deg(errors[:, :3].std()) == pytest.approx(0.04, rel=0.2)
    assert errors[:, 3:].std() == pytest.approx(0.0005, rel=0.2)


def test_scale_of_depth_spreads_by_the_bias() -> None:
    scale = [unit.raw_model.numerator_m / unit.factory.raw_model.numerator_m for unit in UNITS]
    assert np.std(scale) == pytest.approx(0.01, rel=0.25)
    unbiased = draw_unit(SETTINGS.model_copy(update={"depth_bias": 0.0}), 0)
    assert unbiased.raw_model == unbiased.factory.raw_model


def test_changing_one_knob_leaves_the_other_draws_alone() -> None:
    other = draw_unit(SETTINGS.model_copy(update={"depth_bias": 0.03, "exposure_spread": 0.0}), 7)
    assert other.color == UNITS[7].color
    assert np.array_equal(other.T_color_depth, UNITS[7].T_color_depth)


def test_a_lens_that_was_measured_is_told() -> None:
    units = [draw_unit(SETTINGS.model_copy(update={"lens_k1": 0.1}), camera) for camera in range(64)]
    assert np.std([unit.factory.color.dist[0] for unit in units]) == pytest.approx(0.1, rel=0.25)
    assert max(abs(unit.color.dist[0] - unit.factory.color.dist[0]) for unit in units) < 0.005


def test_cameras_stand_off_the_drawing_by_a_degree_and_five_millimetres() -> None:
    drawing = ring_drawing(SETTINGS)
    errors = np.array(
        [se3_log(inverse(drawing.T_rig_camera(i)) @ draw_T_rig_camera(SETTINGS, i)) for i in range(64)]
    )
    assert np.rad2deg(errors[:, :3].std()) == pytest.approx(1.0, rel=0.15)
    assert errors[:, 3:].std() == pytest.approx(0.005, rel=0.15)


def test_a_knock_moves_one_camera_from_its_frame_on() -> None:
    knocked = SETTINGS.model_copy(update={"knock": Knock(camera=2, from_frame=5)})
    assert np.array_equal(draw_T_rig_camera(knocked, 1, 9), draw_T_rig_camera(SETTINGS, 1))
    assert np.array_equal(draw_T_rig_camera(knocked, 2, 4), draw_T_rig_camera(SETTINGS, 2))
    moved = inverse(draw_T_rig_camera(SETTINGS, 2)) @ draw_T_rig_camera(knocked, 2, 5)
    assert rotation_angle_deg(moved) == pytest.approx(4.0)
    assert np.linalg.norm(se3_log(moved)[3:]) == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("cameras", "step_deg", "pairs"), [(1, 30, 0), (4, 30, 3), (12, 30, 12), (16, 22.5, 16)]
)
def test_rings_of_any_size_overlap_and_close_when_they_are_full(
    cameras: int, step_deg: float, pairs: int
) -> None:
    settings = SimulatorSettings(cameras=cameras)
    assert settings.yaw_step_deg == step_deg
    assert len(settings.overlaps) == pairs


@pytest.mark.parametrize(
    "options", [{"depthless_camera": 12}, {"knock": {"camera": 12}}, {"room_m": (1, 4, 2)}]
)
def test_settings_that_make_no_sense_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"camera|room_m"):
        SimulatorSettings.model_validate(options)
