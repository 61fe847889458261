"""The mesh: no cracks between blocks or tiles, outward, small pieces gone, files that others open upright."""

from collections import Counter
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh

from rig_calib.fusion.ply import read_ply
from rig_calib.fusion.voxels import voxel_index, voxel_keys
from rig_calib.tsdf.extraction import extract_mesh
from rig_calib.tsdf.kernels import SIDE, UNITS_A_METRE
from rig_calib.tsdf.mesh import LEAST_PIECE_M2, Mesh
from rig_calib.tsdf.mesh_files import write_mesh_glb, write_mesh_ply
from rig_calib.tsdf.volume import Volume
from rig_protocol.poses import se3_exp

VOXEL_M = 0.01
CENTRE, RADIUS_M = np.array([0.013, -0.004, 0.007]), 0.35  # over eight tiles of 0.64 m, 800 blocks


def lattice(half_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Keys of the blocks of a cube, and its voxels' places (B,512,3) in metres."""
    steps = np.arange(-half_m, half_m + 1e-9, SIDE * VOXEL_M)
    points = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    keys = np.unique(voxel_keys(points, SIDE * VOXEL_M))
    inner = np.stack(np.unravel_index(np.arange(SIDE**3), (SIDE,) * 3), axis=-1)
    return keys, (voxel_index(keys)[:, None] * SIDE + inner) * VOXEL_M


def volume_of(keys: np.ndarray, distance_m: np.ndarray) -> Volume:
    volume = Volume.at(keys, VOXEL_M)
    volume.sums.distance[:] = np.rint(distance_m * UNITS_A_METRE)
    volume.sums.weight[:] = 1
    return volume


def sphere_volume() -> tuple[Volume, np.ndarray]:
    keys, places = lattice(0.48)
    return volume_of(keys, np.linalg.norm(places - CENTRE, axis=-1) - RADIUS_M), places


def faces_an_edge(mesh: Mesh) -> Counter[int]:
    edges = np.sort(
        np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1
    )
    return Counter(np.unique(edges, axis=0, return_counts=True)[1].tolist())


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return extract_mesh(sphere_volume()[0])


def test_a_sphere_over_many_blocks_is_closed_and_has_its_size(sphere: Mesh) -> None:
    assert set(faces_an_edge(sphere)) == {2}
    edges = 3 * len(sphere.faces) // 2
    assert len(sphere.vertices_m) - edges + len(sphere.faces) == 2  # Euler: one sphere
    off_m = np.linalg.norm(sphere.vertices_m - CENTRE, axis=1) - RADIUS_M
    assert np.abs(off_m).max() < VOXEL_M**2 / (8 * RADIUS_M) + 3e-5  # the sagitta of a voxel, and rounding
    a, b, c = (sphere.vertices_m[sphere.faces[:, k]] for k in range(3))
    volume_m3 = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6  # positive: outward
    assert volume_m3 == pytest.approx(4 / 3 * np.pi * RADIUS_M**3, rel=2e-3)
    assert sphere.holes() == (0, 0.0)


def test_normals_point_outward(sphere: Mesh) -> None:
    outward = (sphere.vertices_m - CENTRE) / RADIUS_M
    assert ((sphere.normals() * outward).sum(axis=1) > 0.99).all()


def test_a_rough_surface_has_no_cracks_either() -> None:
    keys, places = lattice(0.48)
    clean_m = np.linalg.norm(places - CENTRE, axis=-1) - RADIUS_M
    noise_m = np.random.default_rng(1).normal(0, 0.3 * VOXEL_M, clean_m.shape)
    mesh = extract_mesh(volume_of(keys, clean_m + noise_m))
    assert all(count % 2 == 0 for count in faces_an_edge(mesh))


def test_a_surface_that_runs_through_voxels_is_closed_too() -> None:
    keys, places = lattice(0.48)
    distance_m = np.abs(places).max(axis=-1) - 0.3  # faces of the cube lie on voxels: distance exactly 0
    assert (distance_m == 0).any() or (np.rint(distance_m * UNITS_A_METRE) == 0).any()
    mesh = extract_mesh(volume_of(keys, distance_m))
    assert set(faces_an_edge(mesh)) == {2}
    assert mesh.area_m2() == pytest.approx(6 * 0.6**2, rel=0.02)


def test_rims_are_where_voxels_are_unknown_and_nowhere_else() -> None:
    volume, places = sphere_volume()
    for sums in (volume.sums.weight, volume.sums.distance):
        sums[places[..., 2] > 0.2] = 0
    mesh = extract_mesh(volume)
    rims = mesh.rims()
    assert len(rims)
    np.testing.assert_allclose(mesh.vertices_m[np.unique(rims), 2], 0.2, atol=1e-6)
    count, length_m = mesh.holes()
    rim_radius_m = np.sqrt(RADIUS_M**2 - (0.2 - CENTRE[2]) ** 2)
    assert count == 1
    assert length_m == pytest.approx(2 * np.pi * rim_radius_m, rel=0.01)


def test_colours_lie_between_those_of_the_voxels() -> None:
    volume, places = sphere_volume()
    ramp = np.clip(128 + 200 * places, 0, 255)
    volume.sums.color_weight[:] = 2
    volume.sums.color[:] = 2 * np.rint(ramp)
    mesh = extract_mesh(volume)
    assert np.abs(mesh.colors - (128 + 200 * mesh.vertices_m)).max() < 1.6  # two roundings


def test_a_vertex_without_colour_takes_its_neighbours() -> None:
    volume, places = sphere_volume()
    known = places[..., 0] < 0.3
    volume.sums.color_weight[known], volume.sums.color[known] = 1, (10, 20, 30)
    assert (extract_mesh(volume).colors == (10, 20, 30)).all()


def test_small_floating_pieces_are_left_out_and_large_ones_kept() -> None:
    keys, places = lattice(0.48)
    small_m = np.sqrt(LEAST_PIECE_M2 / (4 * np.pi))

    def spheres(second_m: float) -> Mesh:
        large = np.linalg.norm(places - (0.2, 0.0, 0.0), axis=-1) - 0.15
        second = np.linalg.norm(places - (-0.25, 0.1, 0.1), axis=-1) - second_m
        return extract_mesh(volume_of(keys, np.minimum(large, second)))

    for second_m, kept in ((0.8 * small_m, 1), (1.3 * small_m, 2)):
        mesh = spheres(second_m).without_small_pieces()
        assert len(trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).split()) == kept
        assert set(mesh.faces.ravel()) == set(range(len(mesh.vertices_m)))


def test_an_empty_volume_gives_an_empty_mesh() -> None:
    mesh = extract_mesh(Volume.at(np.empty(0, np.int64), VOXEL_M)).without_small_pieces()
    assert (len(mesh.vertices_m), len(mesh.faces), mesh.holes()) == (0, 0, (0, 0.0))


def colored(sphere: Mesh) -> Mesh:
    return Mesh(
        sphere.vertices_m, sphere.faces, np.tile(np.uint8([188, 255, 0]), (len(sphere.vertices_m), 1))
    )


def test_the_ply_is_the_mesh_in_the_rig_frame(sphere: Mesh, tmp_path: Path) -> None:
    write_mesh_ply(tmp_path / "mesh.ply", colored(sphere))
    opened = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(opened.vertices, sphere.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(opened.faces, sphere.faces)
    assert (opened.visual.vertex_colors[:, :3] == (188, 255, 0)).all()
    header = (tmp_path / "mesh.ply").read_bytes()[:600]
    assert b"binary_little_endian" in header
    assert b"property float nx" in header
    assert len(read_ply(tmp_path / "mesh.ply")) == len(sphere.vertices_m)


def test_the_glb_stands_upright_in_metres_and_keeps_the_rig_frame_inside(
    sphere: Mesh, tmp_path: Path
) -> None:
    T_rig_view = se3_exp(np.array([0.3, -0.5, 1.0, 0.1, 0.2, -0.3]))
    write_mesh_glb(tmp_path / "mesh.glb", colored(sphere), T_rig_view)
    scene = trimesh.load_scene(tmp_path / "mesh.glb")
    [(name, geometry)] = scene.geometry.items()
    np.testing.assert_allclose(geometry.vertices, sphere.vertices_m, atol=1e-6)
    T_gltf_rig, _ = scene.graph[next(iter(scene.graph.nodes_geometry))]
    up, front, origin = T_rig_view[:, 2], T_rig_view[:, 0], T_rig_view[:, 3]
    np.testing.assert_allclose(T_gltf_rig @ up, [0, 1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(T_gltf_rig @ front, [0, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(T_gltf_rig @ origin, [0, 0, 0, 1], atol=1e-6)
    assert name == "surface"


def test_another_gltf_library_reads_the_glb_with_normals_and_linear_unlit_colours(
    sphere: Mesh, tmp_path: Path
) -> None:
    write_mesh_glb(tmp_path / "mesh.glb", colored(sphere), np.eye(4))
    gltf = pygltflib.GLTF2().load(tmp_path / "mesh.glb")
    [primitive] = gltf.meshes[0].primitives
    position, color = (
        gltf.accessors[k] for k in (primitive.attributes.POSITION, primitive.attributes.COLOR_0)
    )
    assert position.count == len(sphere.vertices_m)
    np.testing.assert_allclose(position.min, sphere.vertices_m.min(axis=0), atol=1e-6)
    assert primitive.attributes.NORMAL is not None
    assert gltf.accessors[primitive.indices].count == sphere.faces.size
    assert "KHR_materials_unlit" in gltf.extensionsUsed
    assert "KHR_materials_unlit" in gltf.materials[primitive.material].extensions
    view = gltf.bufferViews[color.bufferView]
    first = gltf.binary_blob()[(view.byteOffset or 0) : (view.byteOffset or 0) + 3]
    assert tuple(first) == (128, 255, 0)  # sRGB 188 is half of the light
