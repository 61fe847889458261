"""Rules of what the calibration is measured with: truth, noise and bound of a simulated scene."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_agent.simulator.kinect_noise import smooth_field
from rig_agent.simulator.noise_bank import correlated_noise
from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.view import views_from_panoramas
from rig_protocol.frames import PanoramicFrame
from rig_protocol.poses import adjoint, inverse
from rig_protocol.rig_folder import RingDrawing
from support.cramer_rao import Bound, cramer_rao
from support.disparity_statistics import distortion_modes, window_covariance
from support.offered_matches import Matches, Pair, TrueRig, keypoint_noise, offered_matches
from support.rendered_rig import RenderedRig
from support.true_optics import first_hits, pixels_of_points, rays_of_pixels

SETTINGS = SimulatorSettings(cameras=2, seed=4, blocked_overlaps=0)
PAIR = (0, 1)


@pytest.fixture(scope="module")
def true() -> TrueRig:
    rig = VirtualRig(SETTINGS)
    panorama = PanoramicFrame.of(0, {i: rig.camera(i).frame(0) for i in range(2)})
    views = tuple(views_from_panoramas(rig_description(SETTINGS), [panorama]))
    return TrueRig.of(RenderedRig(SETTINGS, views, RingDrawing(), true_poses(SETTINGS), Path()))


@pytest.fixture(scope="module")
def matches(true: TrueRig) -> dict[Pair, Matches]:
    return offered_matches(true)


def bound(
    true: TrueRig, matches: dict[Pair, Matches], keep: slice = slice(None), sigma_px: float = 0.1
) -> Bound:
    found = matches[PAIR]
    kept = Matches(
        (found.pixels[0][keep], found.pixels[1][keep]),
        (found.scales_px[0][keep], found.scales_px[1][keep]),
        found.points[keep],
        found.errors[keep],
    )
    noise = np.full(len(kept), sigma_px)
    return cramer_rao(true, {PAIR: kept}, {PAIR: (noise, noise)})


def test_rays_meet_what_the_renderer_draws(true: TrueRig) -> None:
    rendered = VirtualRig(SETTINGS).camera(0).view().color_z_m()
    rows, columns = (axis.ravel() for axis in np.mgrid[5:480:50, 5:640:50])
    pixels = np.column_stack([columns, rows]).astype(float)
    rays = rays_of_pixels(true.units[0].color, pixels)
    z = first_hits(true.scene.surfaces, true.T_room_color(0), rays).points[:, 2]
    # At an edge rounding may decide which side a ray belongs to.
    assert (np.abs(z / rendered[rows, columns] - 1) < 1e-4).mean() > 0.97


def test_pixels_and_rays_are_inverse(true: TrueRig) -> None:
    camera = replace(true.units[0].color, dist=(0.1, -0.05, 0.0, 0.0, 0.01))
    pixels = np.random.default_rng(0).uniform((0, 0), (639, 479), (50, 2))
    rays = rays_of_pixels(camera, pixels)
    np.testing.assert_allclose(
        pixels_of_points(camera, np.column_stack([rays, np.ones(50)])), pixels, atol=1e-6
    )


def test_means_of_windows_vary_together_as_stated() -> None:
    noise = correlated_noise(np.random.default_rng(1), (3000, 3000))
    for half in (8, 3):
        means = cv2.blur(noise, (2 * half + 1,) * 2)[20:-20, 20:-20]
        for column, row in ((0, 0), (6, 0), (0, 11)):
            measured = float(
                (means[row:, column:] * means[: len(means) - row, : means.shape[1] - column]).mean()
            )
            stated = window_covariance(np.array([[column, row]]), half, half)[0]
            assert measured == pytest.approx(stated, abs=0.02)


def test_modes_have_the_covariance_of_the_distortion() -> None:
    rng = np.random.default_rng(2)
    fields = np.stack([smooth_field(rng, (48, 64))[::10, ::12].ravel() for _ in range(1500)])
    rows, columns = (axis.ravel() for axis in np.mgrid[0:48:10, 0:64:12])
    modes = distortion_modes(np.column_stack([columns, rows]).astype(float), (48, 64))
    assert modes.shape[1] < 25
    np.testing.assert_allclose(modes @ modes.T, fields.T @ fields / len(fields), atol=0.012)


def test_true_matches_are_many_and_exact(matches: dict[Pair, Matches]) -> None:
    found = matches[PAIR]
    assert len(found) > 100
    assert np.median(np.abs(found.errors)) < 0.3
    noise = keypoint_noise([found])
    assert 0.02 < float(noise.sigma_px(1.5)) < 0.3


def test_without_matches_the_bound_is_the_drawings_tolerance(
    true: TrueRig, matches: dict[Pair, Matches]
) -> None:
    nothing = bound(true, matches, slice(0, 0))
    sigma = np.repeat([np.deg2rad(SETTINGS.mounting_deg), SETTINGS.mounting_m], 3)
    Ad = adjoint(inverse(true.rig.truth[1]) @ true.rig.truth[0])
    expected = np.diag(sigma**2) + Ad @ np.diag(sigma**2) @ Ad.T
    np.testing.assert_allclose(nothing.relative(*PAIR), expected, rtol=1e-6, atol=1e-12)


def test_the_bound_falls_with_matches_and_with_less_noise(
    true: TrueRig, matches: dict[Pair, Matches]
) -> None:
    few, all_, noisy = (
        bound(true, matches, slice(0, 20)),
        bound(true, matches),
        bound(true, matches, sigma_px=0.5),
    )
    for worse in (few, noisy):
        assert np.linalg.eigvalsh(worse.relative(*PAIR) - all_.relative(*PAIR)).min() > -1e-12
        assert worse.rmse([PAIR])[1] > 1.1 * all_.rmse([PAIR])[1]


def test_unknown_units_cost_accuracy(true: TrueRig, matches: dict[Pair, Matches]) -> None:
    perfect = SETTINGS.model_copy(
        update={"factory_error": 1e-6, "depth_bias": 1e-6, "depth_distortion_mm": 1e-6}
    )
    known = replace(true, rig=replace(true.rig, settings=perfect))
    assert bound(known, matches).rmse([PAIR])[1] < 0.7 * bound(true, matches).rmse([PAIR])[1]


def test_a_camera_without_depth_is_bound_by_its_neighbour(
    true: TrueRig, matches: dict[Pair, Matches]
) -> None:
    views = true.rig.views
    blind = replace(true, rig=replace(true.rig, views=(replace(views[0], raw=()), views[1])))
    without, with_both = bound(blind, matches).rmse([PAIR]), bound(true, matches).rmse([PAIR])
    assert with_both[1] < without[1] < 5 * with_both[1]
