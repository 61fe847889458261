"""Rules of the depth sensor, after measured properties of real Kinects."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from rig_agent.simulator.kinect_noise import (
    BLIND_COLUMNS,
    CleanDepth,
    DisparitySensor,
    distortion_amplitude,
    smooth_field,
)
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.camera import RawDepthModel
from rig_protocol.frames import NO_DISPARITY

SHAPE = (480, 640)
MODEL = RawDepthModel()
PLAIN = SimulatorSettings(depth_distortion_mm=0, interference=0)
Field = npt.NDArray[np.float64]


def clean_depth(z_m: float | npt.NDArray[np.float32] = 2.0, angle_deg: float = 0.0) -> CleanDepth:
    nothing = np.zeros(SHAPE, bool)
    z = np.broadcast_to(np.float32(z_m), SHAPE).copy()
    return CleanDepth(z, np.full(SHAPE, np.cos(np.deg2rad(angle_deg)), np.float32), nothing, nothing)


def slanted_wall() -> npt.NDArray[np.float32]:
    """Depths 1.5 to 2.6 m whose disparity crosses many steps, as walls do: rounding is then random."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.asarray(1 / (0.38 + 0.0003 * u + 0.0002 * v), dtype=np.float32)


def residuals(settings: SimulatorSettings, angle_deg: float = 0.0, frames: int = 6) -> Field:
    """Measured minus ideal disparity (frames, rows, columns) of the slanted wall."""
    z = slanted_wall()
    sensor = DisparitySensor(np.random.default_rng(1), clean_depth(z, angle_deg), MODEL, settings)
    ideal = MODEL.offset - MODEL.numerator_m / z
    raw = np.array([sensor.frame(np.random.default_rng(10 + k)) for k in range(frames)], dtype=np.float64)
    return (raw - ideal)[..., :-BLIND_COLUMNS]


def autocorrelation(field: Field, lag: int, axis: int) -> float:
    centred = np.moveaxis(field - field.mean(), axis, 0)
    return float((centred[lag:] * centred[:-lag]).mean() / centred.var())


@pytest.mark.parametrize("lsb", [0.5, 0.55, 0.8])
def test_total_noise_is_what_the_setting_says(lsb: float) -> None:
    assert residuals(PLAIN.model_copy(update={"disparity_noise_lsb": lsb})).std() == pytest.approx(
        lsb, rel=0.04
    )


def test_reference_noise_is_at_least_half_an_lsb_and_unbiased() -> None:
    noise = residuals(PLAIN)
    assert 0.5 <= noise.std() < 0.62
    assert abs(noise.mean()) < 0.05


@pytest.mark.parametrize("axis", [0, 1])
def test_noise_is_correlated_over_the_window_as_measured(axis: int) -> None:
    # kinect.md measured 0.75-0.8 at one pixel and 0.1-0.3 at 8-12 px.
    field = residuals(PLAIN, frames=1)[0]
    assert 0.68 < autocorrelation(field, 1, axis) < 0.85
    assert 0.1 < autocorrelation(field, 8, axis) < 0.3
    assert abs(autocorrelation(field, 60, axis)) < 0.05


def test_part_of_the_noise_is_frozen_and_averaging_leaves_it() -> None:
    noise = residuals(PLAIN, frames=12)
    fresh_variance = noise.var(axis=0, ddof=1).mean()
    frozen_variance = noise.mean(axis=0).var() - fresh_variance / len(noise)
    continuous = PLAIN.disparity_noise_lsb**2 - 1 / 12
    assert frozen_variance == pytest.approx(PLAIN.frozen_noise * continuous, rel=0.15)


def test_fresh_noise_of_two_frames_is_independent() -> None:
    noise = residuals(PLAIN.model_copy(update={"frozen_noise": 0.0}), frames=4)
    correlations = np.corrcoef(noise.reshape(4, -1))[np.triu_indices(4, 1)]
    # Correlated noise leaves some 1,500 independent samples an image: chance alone reaches 0.08.
    assert np.abs(correlations).max() < 0.12


def test_noise_grows_with_incidence_and_nothing_is_measured_beyond_eighty_degrees() -> None:
    assert residuals(PLAIN, angle_deg=75).std() > 1.2 * residuals(PLAIN).std()
    sensor = DisparitySensor(np.random.default_rng(0), clean_depth(2.0, 81), MODEL, PLAIN)
    assert (sensor.frame(np.random.default_rng(0)) == NO_DISPARITY).all()


@pytest.mark.parametrize("z_m", [0.45, 5.2])
def test_nothing_is_measured_out_of_range(z_m: float) -> None:
    sensor = DisparitySensor(np.random.default_rng(0), clean_depth(z_m), MODEL, PLAIN)
    assert (sensor.frame(np.random.default_rng(0)) == NO_DISPARITY).all()


def test_right_hand_columns_and_shadows_are_blind_and_the_rest_is_not() -> None:
    shadow = np.zeros(SHAPE, bool)
    shadow[100:200, 50:60] = True
    clean = replace(clean_depth(), shadow=shadow)
    raw = DisparitySensor(np.random.default_rng(0), clean, MODEL, PLAIN).frame(np.random.default_rng(0))
    blind = shadow.copy()
    blind[:, -BLIND_COLUMNS:] = True
    assert np.array_equal(raw == NO_DISPARITY, blind)
    assert raw.dtype == np.uint16


def test_interference_spoils_the_stated_share_of_lit_pixels_only() -> None:
    lit = np.zeros(SHAPE, bool)
    lit[:240] = True
    settings = PLAIN.model_copy(update={"interference": 0.05})
    sensor = DisparitySensor(
        np.random.default_rng(0), replace(clean_depth(), interfered=lit), MODEL, settings
    )
    holes = [sensor.frame(np.random.default_rng(k))[:, :-BLIND_COLUMNS] == NO_DISPARITY for k in range(6)]
    assert np.mean([hole[:240].mean() for hole in holes]) == pytest.approx(0.05, abs=0.02)
    assert not any(hole[240:].any() for hole in holes)
    assert (holes[0] != holes[1]).any()


def test_distortion_is_smooth_and_as_large_as_on_a_measured_unit() -> None:
    # kinect.md: 34 mm peak to peak at 1.5 m and 17 mm at 0.7 m.
    settings = SimulatorSettings()
    spans_mm: dict[float, list[float]] = {0.7: [], 1.5: []}
    for seed in range(20):
        for z_m, spans in spans_mm.items():
            rng = np.random.default_rng(seed)
            field = smooth_field(rng, SHAPE)
            disparity = np.full(SHAPE, MODEL.offset - MODEL.numerator_m / z_m, np.float32)
            lsb = field * distortion_amplitude(settings, MODEL, disparity)
            spans.append(float(np.ptp(lsb)) * z_m**2 / MODEL.numerator_m * 1000)
            assert np.abs(np.diff(field, axis=1)).max() < 0.02
    assert np.median(spans_mm[1.5]) == pytest.approx(34, rel=0.2)
    assert np.median(spans_mm[0.7]) == pytest.approx(17, rel=0.2)


def test_edges_of_depth_are_ragged_and_planes_stay() -> None:
    z = np.full(SHAPE, 2.0, np.float32)
    z[:, 320:] = 1.2
    exact = PLAIN.model_copy(update={"disparity_noise_lsb": 0.3})
    raw = DisparitySensor(np.random.default_rng(3), clean_depth(z), MODEL, exact).frame(
        np.random.default_rng(0)
    )
    near = raw < MODEL.offset - MODEL.numerator_m / 1.6
    edge = np.argmax(near, axis=1)
    assert 0.3 < edge.std() < 2.0
    assert not near[:, :310].any()
    assert near[:, 330:-BLIND_COLUMNS].all()


def lit_halves() -> CleanDepth:
    """A wall on which one neighbour lights the left half, another the right half."""
    left = np.zeros(SHAPE, bool)
    left[:, : SHAPE[1] // 2] = True
    return replace(clean_depth(slanted_wall()), interfered=np.ones(SHAPE, bool), lit=(left, ~left))


def test_a_dark_projector_disturbs_nothing_and_the_others_as_before() -> None:
    settings = PLAIN.model_copy(update={"interference": 0.3, "interference_noise_lsb": 3.0})
    sensor = DisparitySensor(np.random.default_rng(0), lit_halves(), MODEL, settings)
    both, left_dark, none = (
        sensor.frame(np.random.default_rng(1), dark=frozenset(dark)) for dark in ((), (0,), (0, 1))
    )
    half = SHAPE[1] // 2
    np.testing.assert_array_equal(left_dark[:, half:], both[:, half:])
    assert (both[:, :half] == NO_DISPARITY).mean() > 0.2
    assert not (left_dark[:, :half] == NO_DISPARITY).any()
    undisturbed = DisparitySensor(np.random.default_rng(0), clean_depth(slanted_wall()), MODEL, PLAIN)
    np.testing.assert_array_equal(none, undisturbed.frame(np.random.default_rng(1)))


def test_the_error_by_foreign_dots_has_its_size_and_stands_still() -> None:
    settings = PLAIN.model_copy(update={"interference_noise_lsb": 3.0})
    sensor = DisparitySensor(np.random.default_rng(0), lit_halves(), MODEL, settings)
    ideal = MODEL.offset - MODEL.numerator_m / slanted_wall()
    frames = np.array([sensor.frame(np.random.default_rng(k)) for k in range(8)]) - ideal
    seen = frames.mean(axis=0)[:, :-BLIND_COLUMNS]
    assert seen.std() == pytest.approx(3.0, rel=0.1)
