"""Projection: its inverse and its derivatives."""

import numpy as np
import pytest

from rig_calib.projection import inside, pixel_rays, project, project_jacobian, undistort_pixels
from rig_protocol.camera import Intrinsics

PINHOLE = Intrinsics(525.0, 526.0, 319.5, 239.5)
# The colour camera of the TUM sequence freiburg1: as strong a lens as Kinects have.
DISTORTED = Intrinsics(517.3, 516.5, 318.6, 255.3, dist=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
POINTS = np.random.default_rng(0).uniform((-0.7, -0.5, 0.9), (0.7, 0.5, 1.4), (50, 3))


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_a_pixels_ray_projects_onto_the_pixel(camera: Intrinsics) -> None:
    rays = pixel_rays(camera).reshape(-1, 2)
    v, u = np.mgrid[: camera.height, : camera.width]
    back = project(camera, np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(back, np.column_stack([u.ravel(), v.ravel()]), atol=1e-8)


def test_the_principal_point_sees_straight_ahead() -> None:
    assert project(PINHOLE, np.array([[0.0, 0.0, 2.0]])).tolist() == [[319.5, 239.5]]


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_jacobian_is_the_derivative(camera: Intrinsics) -> None:
    step = 1e-6
    numeric = np.stack(
        [(project(camera, POINTS + d) - project(camera, POINTS - d)) / (2 * step) for d in step * np.eye(3)],
        axis=-1,
    )
    np.testing.assert_allclose(project_jacobian(camera, POINTS), numeric, atol=1e-5)


def test_a_pixel_beyond_the_lens_models_reach_has_no_ray() -> None:
    folding = Intrinsics(500.0, 500.0, 320.0, 240.0, dist=(-0.5, 0.0, 0.0, 0.0, 0.0))
    rays = undistort_pixels(folding, np.array([[320.0, 240.0], [320.0 + 500.0, 240.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_inside_reaches_half_a_pixel_past_the_outermost_centres() -> None:
    pixels = np.array([[-0.4, 0.0], [-0.6, 0.0], [639.4, 479.4], [639.6, 479.0]])
    assert inside(PINHOLE, pixels).tolist() == [True, False, True, False]
