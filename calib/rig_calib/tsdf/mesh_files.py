"""Mesh files: PLY as it is, in the rig frame; GLB upright, as glTF has it."""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig_calib.fusion.linear_light import LINEAR_LIGHT
from rig_calib.tsdf.mesh import Mesh
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse

if TYPE_CHECKING:
    import trimesh

# glTF 2.0, 3.3: +Y is up, a thing's front looks to +Z, units are metres. A view has z up and x to the front.
_T_GLTF_VIEW = np.array(
    [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_UNLIT = "KHR_materials_unlit"


def require_libraries() -> None:
    """ConfigurationError, with what to install, where meshes can be neither made nor written."""
    for name in ("skimage", "trimesh"):
        if importlib.util.find_spec(name) is None:
            raise ConfigurationError(
                f"a mesh needs the Python package {name}: pip install 'kinect-rig[mesh]'"
            )


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Binary PLY with normals and colours, in metres of the rig frame; the file whole or not at all."""
    from trimesh.exchange.ply import export_ply

    _write(path, export_ply(_trimesh(mesh, mesh.colors), vertex_normal=True))


def write_mesh_glb(path: Path, mesh: Mesh, T_rig_view: Pose) -> None:
    """Binary glTF 2.0, the file whole or not at all.

    The vertices are those of the rig frame; the node turns the view's up to +Y and its front to +Z. Colours
    are linear, as glTF asks, and unlit: the photographed light is in them already.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene()
    scene.add_geometry(
        _trimesh(mesh, _linear(mesh.colors)),
        node_name="rig",
        geom_name="surface",
        transform=_T_GLTF_VIEW @ inverse(T_rig_view),
    )
    _write(path, export_glb(scene, include_normals=True, tree_postprocessor=_make_unlit))


def _trimesh(mesh: Mesh, colors: ImageU8) -> "trimesh.Trimesh":
    import trimesh

    return trimesh.Trimesh(
        vertices=mesh.vertices_m,
        faces=mesh.faces,
        vertex_normals=mesh.normals(),
        vertex_colors=colors,
        process=False,
    )


def _write(path: Path, written: bytes) -> None:
    with whole_file(path) as file:
        file.write(written)


def _linear(colors: ImageU8) -> ImageU8:
    return np.asarray(np.rint(255 * LINEAR_LIGHT).astype(np.uint8)[colors])


def _make_unlit(tree: dict[str, Any]) -> None:
    tree["materials"] = [{"name": "seen", "extensions": {_UNLIT: {}}}]
    tree["extensionsUsed"] = [*tree.get("extensionsUsed", []), _UNLIT]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
