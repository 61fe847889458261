"""Rules of the renderer: rays meet what they should, and images agree with depth to a tenth of a pixel."""

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from rig_agent.simulator.lens import ray_grid
from rig_agent.simulator.renderer import NOTHING, cast, cosine_of_incidence
from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.surface import Box, Surface
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, se3_exp, transform_points

CAMERA = Intrinsics(525.0, 526.0, 318.0, 242.0)
Image = npt.NDArray[np.float32]


def facing_wall(z_m: float) -> Surface:
    """A wall of 2 × 1 m around the optical axis, its front towards the camera at the origin."""
    return Surface(np.array([-1.0, 0.5, z_m]), np.array([2.0, 0, 0]), np.array([0, -1.0, 0]), "paint")


def backwards(surface: Surface) -> Surface:
    return Surface(surface.corner, surface.edge_v, surface.edge_u, surface.material)


def project(camera: Intrinsics, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Pixels of points (N,3), by the textbook: the renderer goes the other way."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    k1, k2, _, _, k3 = camera.dist
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.stack([camera.fx * x * radial + camera.cx, camera.fy * y * radial + camera.cy], axis=-1)


def test_rays_of_a_distorted_lens_project_back_to_their_pixels() -> None:
    camera = Intrinsics(529.2, 525.6, 328.9, 267.5, dist=(0.25, -0.3, 0.0, 0.0, 0.1))
    rays = ray_grid(camera)
    points = np.stack([rays.x, rays.y, np.ones_like(rays.x)], axis=-1).reshape(-1, 3).astype(np.float64)
    v, u = np.mgrid[: camera.height, : camera.width]
    assert np.abs(project(camera, points) - np.stack([u.ravel(), v.ravel()], axis=-1)).max() < 1e-3


def test_samples_lie_evenly_inside_their_pixels() -> None:
    fine, coarse = ray_grid(CAMERA, 2), ray_grid(CAMERA)
    mean = fine.x.reshape(480, 2, 640, 2).mean(axis=(1, 3))
    assert np.allclose(mean, coarse.x, atol=1e-6)


def test_a_facing_wall_is_hit_at_its_depth_and_within_its_edges_only() -> None:
    rays = ray_grid(CAMERA)
    hits = cast([facing_wall(2.5)], np.eye(4), rays)
    inside = (np.abs(rays.x * 2.5) < 1.0) & (np.abs(rays.y * 2.5) < 0.5)
    assert np.array_equal(hits.surface != NOTHING, inside)
    assert np.allclose(1 / hits.inverse_z[inside], 2.5, atol=1e-5)


def test_the_nearer_surface_hides_the_farther_whatever_their_order() -> None:
    near, far = facing_wall(1.0), facing_wall(2.0)
    for surfaces in ([near, far], [far, near]):
        hits = cast(surfaces, np.eye(4), ray_grid(CAMERA))
        assert 1 / hits.inverse_z[242, 318] == pytest.approx(1.0)


def test_a_surface_is_seen_from_its_front_only() -> None:
    hits = cast([backwards(facing_wall(2.0))], np.eye(4), ray_grid(CAMERA))
    assert (hits.surface == NOTHING).all()


def test_a_surface_that_reaches_behind_the_camera_is_cut_not_dropped() -> None:
    floor = Surface(np.array([-5.0, 1.0, -5.0]), np.array([10.0, 0, 0]), np.array([0, 0, 10.0]), "paint")
    rays = ray_grid(CAMERA)
    hits = cast([floor], np.eye(4), rays)
    assert np.allclose(1 / hits.inverse_z[400], 1.0 / rays.y[400], rtol=1e-4)


def test_boxes_are_closed_and_face_outward() -> None:
    T = se3_exp(np.array([0, 0, 0.7, 1.0, -2.0, 0.0]))
    faces = Box(0.1, 0.2, 0.3, (0.5, 0.6, 0.7), "wood").surfaces(T)
    centre = transform_points(T, np.array([0.1, 0.2, 0.65]))
    assert all((face.corners.mean(axis=0) - centre) @ face.normal > 0.2 for face in faces)
    areas = np.array([np.cross(face.edge_u, face.edge_v) for face in faces])
    # The divergence theorem: outward areas of a closed body sum to nothing.
    assert np.allclose(areas.sum(axis=0), 0)
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(2 * (0.3 + 0.35 + 0.42))


def test_incidence_is_the_angle_between_ray_and_normal() -> None:
    rays = ray_grid(CAMERA)
    surfaces = [facing_wall(2.0)]
    cosine = cosine_of_incidence(surfaces, cast(surfaces, np.eye(4), rays), np.eye(4), rays)
    assert cosine[242, 318] == pytest.approx(1.0, abs=1e-5)
    assert cosine[242, 500] == pytest.approx(np.cos(np.arctan(float(rays.x[242, 500]))), abs=1e-5)
    assert cosine[0, 0] == 0


@pytest.fixture(scope="module")
def neighbours() -> VirtualRig:
    return VirtualRig(SimulatorSettings(cameras=2, seed=5, blocked_overlaps=0, lens_k1=0.05))


def clean_grey(rig: VirtualRig, camera: int) -> Image:
    fine = cv2.cvtColor(rig.camera(camera).view().color(), cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA), dtype=np.float32)


def pixels_in_neighbour(rig: VirtualRig) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Camera 0's points seen from camera 1, (H,W,2) pixels and (H,W) depths, by true depth and poses."""
    first, second = rig.camera(0), rig.camera(1)
    z, rays = first.view().color_z_m(), ray_grid(first.unit.color)
    points = np.stack([rays.x * z, rays.y * z, z], axis=-1).reshape(-1, 3).astype(np.float64)
    T_second_first: Pose = inverse(second.T_rig_camera) @ first.T_rig_camera
    moved = transform_points(T_second_first, points)
    return project(second.unit.color, moved).reshape(480, 640, 2), moved[:, 2].reshape(480, 640)


def test_true_points_have_the_same_depth_in_the_neighbour(neighbours: VirtualRig) -> None:
    pixels, depth = pixels_in_neighbour(neighbours)
    z_second = neighbours.camera(1).view().color_z_m()
    sampled = cv2.remap(
        z_second, pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32), cv2.INTER_LINEAR
    )
    seen = sampled > 0
    assert seen.mean() > 0.2
    # Interpolated depth is a little off on slanted walls and wrong at edges, hence a quantile.
    assert np.quantile(np.abs(sampled[seen] - depth[seen]), 0.8) < 1e-3


def test_images_of_neighbours_agree_to_a_tenth_of_a_pixel(neighbours: VirtualRig) -> None:
    first, second = clean_grey(neighbours, 0), clean_grey(neighbours, 1)
    pixels, depth = pixels_in_neighbour(neighbours)
    u, v = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
    warped = cv2.remap(second, u, v, cv2.INTER_CUBIC, borderValue=-1)
    visible = cv2.remap(neighbours.camera(1).view().color_z_m(), u, v, cv2.INTER_LINEAR)
    same = (np.abs(visible - depth) < 0.01) & (u > 4) & (u < 635) & (v > 4) & (v < 475)
    same = cv2.erode(same.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert same.mean() > 0.1
    # Least squares for the shift of a patch: gradient · shift = difference (Lucas & Kanade 1981).
    gradient = np.stack([cv2.Sobel(first, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(first, cv2.CV_32F, 0, 1) / 8])
    residual = first - warped
    for half in (np.s_[:, :320], np.s_[:, 320:]):
        A, b = gradient[(slice(None), *half)][:, same[half]], residual[half][same[half]]
        shift = np.linalg.solve((A @ A.T).astype(np.float64), (A @ b).astype(np.float64))
        assert np.hypot(*shift) < 0.1
