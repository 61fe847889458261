"""The volume: right distances, noise weighed, space seen through freed; the same bits in any order."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rig_calib.fusion.voxels import voxel_keys
from rig_calib.projection import pixel_rays
from rig_calib.tsdf import volume as volumes
from rig_calib.tsdf.extraction import extract_mesh
from rig_calib.tsdf.kernels import SIDE
from rig_calib.tsdf.mesh import Mesh
from rig_calib.tsdf.range_image import RangeImage
from rig_calib.tsdf.volume import Volume, blocks_near
from rig_protocol.errors import ConfigurationError
from support.box_room import CAMERA, BoxRoom, ring_poses
from support.range_images import KINECT_SIGMA_1M, facing_plane, room_images

VOXEL_M = 0.02
ROOM = room_images(ring_poses(4))


def volume_of(
    images: Sequence[RangeImage], voxel_m: float = VOXEL_M, keys: np.ndarray | None = None
) -> Volume:
    made = Volume.at(blocks_near(images, voxel_m) if keys is None else keys, voxel_m)
    made.add(images)
    return made


def mesh_of(images: Sequence[RangeImage], voxel_m: float = VOXEL_M) -> Mesh:
    return extract_mesh(volume_of(images, voxel_m))


def assert_same(a: Volume, b: Volume) -> None:
    np.testing.assert_array_equal(a.keys, b.keys)
    for name, own, other in zip(a.sums._fields, a.sums, b.sums, strict=True):
        np.testing.assert_array_equal(own, other, err_msg=name)


def middle_depth_m(mesh: Mesh) -> float:
    """Of the vertices around the axis of a camera at the origin."""
    near = np.hypot(mesh.vertices_m[:, 0], mesh.vertices_m[:, 1]) < 0.3
    return float(np.median(mesh.vertices_m[near, 2]))


@pytest.mark.parametrize("z_m", [0.6, 1.503, 4.0])
def test_a_plane_becomes_one_sheet_where_it_is(z_m: float) -> None:
    mesh = mesh_of([facing_plane(z_m)])
    assert np.abs(mesh.vertices_m[:, 2] - z_m).max() < 1e-4  # 10 µm units; interpolation along z is exact
    seen_m2 = (159 / 131.0 * z_m) * (119 / 131.0 * z_m)
    assert seen_m2 * 0.9 < mesh.area_m2() <= seen_m2
    assert (mesh.normals()[:, 2] < -0.99).all()  # to the camera


def test_a_room_is_right_on_slanting_walls_and_no_wall_is_double() -> None:
    mesh = mesh_of(ROOM)
    assert len(mesh.vertices_m) > 10_000
    off_m = BoxRoom().wall_error_m(mesh.vertices_m)
    assert np.median(off_m) < 2e-4
    # Where walls meet, the distance has a kink that voxels of 20 mm round off.
    assert np.percentile(off_m, 99) < 0.25 * VOXEL_M
    assert off_m.max() < VOXEL_M


def test_colours_are_those_of_the_images() -> None:
    mesh = mesh_of([facing_plane(1.5)])
    assert (mesh.colors == (200, 100, 50)).all()


def test_cameras_are_weighed_by_their_variance() -> None:
    ratio = 4.0
    images = [facing_plane(1.5), facing_plane(1.52, sigma_1m=ratio * KINECT_SIGMA_1M)]
    expected_m = 1.5 + 0.02 / (1 + ratio**2)
    assert middle_depth_m(mesh_of(images)) == pytest.approx(expected_m, abs=3e-4)
    assert middle_depth_m(mesh_of([facing_plane(1.5), facing_plane(1.52)])) == pytest.approx(1.51, abs=3e-4)


def test_a_mean_of_frames_counts_as_many() -> None:
    images = [facing_plane(1.5, frames=3), facing_plane(1.52)]
    assert middle_depth_m(mesh_of(images)) == pytest.approx(1.505, abs=3e-4)


def test_what_others_see_through_is_taken_away_and_what_is_behind_a_surface_is_not() -> None:
    ghost, wall = facing_plane(1.0), facing_plane(3.0)
    outvoted = mesh_of([ghost, wall, wall])
    assert (outvoted.vertices_m[:, 2] > 2.5).all()
    confirmed = mesh_of([ghost, ghost, ghost, wall])
    assert {1, 3} == set(np.rint(confirmed.vertices_m[:, 2]).astype(int))


def test_holes_in_the_depth_stay_open() -> None:
    image = facing_plane(1.5)
    image.inverse_depth[50:70, 60:100] = 0
    mesh = mesh_of([image])
    x, y = mesh.vertices_m[:, 0] / 1.5 * 131 + 79.5, mesh.vertices_m[:, 1] / 1.5 * 131 + 59.5
    assert not ((x > 62) & (x < 98) & (y > 52) & (y < 68)).any()


def test_a_distorting_depth_lens_bends_nothing() -> None:
    lens = replace(CAMERA, dist=(0.08, -0.05, 0.002, -0.001, 0.01))
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    rays = pixel_rays(lens)
    image = facing_plane(2.0)
    image.incidence[:] = 1 / np.hypot(1, np.linalg.norm(rays, axis=2))
    image.inverse_depth[:, :100] = 0  # the border of what is measured is a column of the image
    mesh = mesh_of([replace(image, grid=replace(image.grid, intrinsics=lens))])
    assert np.abs(mesh.vertices_m[:, 2] - 2.0).max() < 1e-4
    border = np.array([[[100.0, row]] for row in (20, 60, 100)])
    for x, y in 2.0 * cv2.undistortPoints(border, K, np.array(lens.dist))[:, 0]:
        level = np.abs(mesh.vertices_m[:, 1] - y) < VOXEL_M
        leftmost = mesh.vertices_m[level, 0].min()
        assert abs(leftmost - x) < 1.5 * VOXEL_M  # a cube is there or not


def test_two_volumes_merge_to_the_bits_of_one() -> None:
    keys = blocks_near(ROOM, VOXEL_M)
    whole = volume_of(ROOM, keys=keys)
    first, second = volume_of(ROOM[:1], keys=keys), volume_of(ROOM[1:], keys=keys)
    for parts in ((first, second), (second, first)):
        total = Volume.at(keys, VOXEL_M)
        for part in parts:
            total.take(part)
        assert_same(total, whole)


def test_the_order_of_images_and_the_threads_change_no_bit() -> None:
    whole = volume_of(ROOM)
    other = Volume.at(blocks_near(ROOM[::-1], VOXEL_M), VOXEL_M)
    other.add(ROOM[::-1], threads=5)
    assert_same(other, whole)
    np.testing.assert_array_equal(extract_mesh(other).vertices_m, extract_mesh(whole).vertices_m)


def test_volumes_of_different_places_merge_to_both() -> None:
    near, far = facing_plane(1.0), facing_plane(3.0)
    both = Volume.at(np.union1d(blocks_near([near], VOXEL_M), blocks_near([far], VOXEL_M)), VOXEL_M)
    for image in (near, far):
        both.take(volume_of([image]))
    assert {1, 3} == set(np.rint(extract_mesh(both).vertices_m[:, 2]).astype(int))
    for stranger in (volume_of([near], voxel_m=0.03), volume_of([facing_plane(5.0)])):
        with pytest.raises(ValueError, match="its voxel and blocks"):
            both.take(stranger)


def test_every_voxel_that_a_cube_at_the_surface_needs_has_a_block() -> None:
    keys = set(blocks_near(ROOM, VOXEL_M).tolist())
    for image in ROOM:
        rows, columns = np.nonzero(image.inverse_depth)
        z = 1 / image.inverse_depth[rows, columns].astype(np.float64)
        at = image.grid.intrinsics
        local = np.column_stack([(columns - at.cx) / at.fx * z, (rows - at.cy) / at.fy * z, z])
        points = local @ image.T_rig_grid[:3, :3].T + image.T_rig_grid[:3, 3]
        for corner in np.ndindex(2, 2, 2):
            around = points + (np.array(corner) - 0.5) * 2 * VOXEL_M
            assert set(voxel_keys(around, SIDE * VOXEL_M).tolist()) <= keys


def test_a_voxel_that_needs_too_much_memory_is_refused_with_one_that_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(volumes, "MAX_BLOCKS", 100)
    with pytest.raises(ConfigurationError, match=r"more than the 100 .* take --voxel-mm \d+") as refused:
        volume_of(ROOM)
    enough_m = 1e-3 * int(str(refused.value).split()[-1])
    assert len(volume_of(ROOM[:1], voxel_m=min(enough_m, 0.1))) <= 100
