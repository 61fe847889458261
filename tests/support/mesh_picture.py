"""A picture of a mesh from outside and above, as the figures of clouds have it, without the ceiling."""

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.figures.dollhouse import (
    BACKGROUND,
    HEIGHT_PX,
    WIDTH_PX,
    fit_to_picture,
    perspective,
    spectator_direction,
)
from rig_calib.tsdf.mesh import Mesh
from rig_protocol.compiled import compiled
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]

_FINER = 2  # painted so many times larger, then reduced
_CEILING_M = 0.3  # so much below the highest face that looks down, the room is open
_DIFFUSE = 0.35  # of the shade is the surface's own slant: colours alone hide how rough it is


def mesh_picture(mesh: Mesh, T_rig_view: Pose, azimuth_deg: float) -> ImageU8:
    """The mesh (H,W,3), BGR, from an azimuth of the view frame; faces that look away are left out."""
    points = transform_points(inverse(T_rig_view), mesh.vertices_m)
    towards = spectator_direction(azimuth_deg)
    normals = mesh.face_normals() @ T_rig_view[:3, :3]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    radius = float(np.percentile(np.linalg.norm(points, axis=1), 98))
    across, up, depth = perspective(points, towards, radius)
    ceiling_m = float(np.percentile(points[:, 2], 99.9)) - _CEILING_M
    centre = points[mesh.faces].mean(axis=1)
    to_eye = towards * 3.2 * radius - centre
    # What a rough wall that turns its back has of faces to the front would stand before the room as specks.
    smooth = (mesh.normals() @ T_rig_view[:3, :3])[mesh.faces].mean(axis=1)
    facing = ((normals * to_eye).sum(axis=1) > 0) & ((smooth * to_eye).sum(axis=1) > 0)
    shown = facing & (centre[:, 2] < ceiling_m)
    used = np.unique(mesh.faces[shown])
    scale, left, top = fit_to_picture(across[used], up[used])
    corners = np.column_stack([across * scale + left, top - up * scale, depth]) * (_FINER, _FINER, 1.0)
    shade = 1.0 - _DIFFUSE + _DIFFUSE * np.abs(normals @ spectator_direction(azimuth_deg + 35.0))
    image = np.full((HEIGHT_PX * _FINER, WIDTH_PX * _FINER, 3), BACKGROUND, np.uint8)
    nearest = np.full(image.shape[:2], np.inf)
    _paint(corners, mesh.faces[shown], mesh.colors[:, ::-1].astype(np.float64), shade[shown], image, nearest)
    return np.asarray(cv2.resize(image, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), dtype=np.uint8)


@compiled()
def _paint(
    corners: Array,
    faces: npt.NDArray[np.int64],
    colors: Array,
    shade: Array,
    image: ImageU8,
    nearest: Array,
) -> None:
    """Fill triangles whose corners are column, row and depth; the nearest stays."""
    height, width = nearest.shape
    for face in range(len(faces)):
        a, b, c = faces[face]
        ax, ay = corners[a, 0], corners[a, 1]
        bx, by, cx, cy = corners[b, 0] - ax, corners[b, 1] - ay, corners[c, 0] - ax, corners[c, 1] - ay
        area = bx * cy - by * cx
        if area == 0.0:
            continue
        first = max(int(np.floor(ax + min(0.0, bx, cx))), 0), max(int(np.floor(ay + min(0.0, by, cy))), 0)
        last = min(int(ax + max(0.0, bx, cx)) + 1, width - 1), min(int(ay + max(0.0, by, cy)) + 1, height - 1)
        for row in range(first[1], last[1] + 1):
            for column in range(first[0], last[0] + 1):
                x, y = column - ax, row - ay
                s, t = (x * cy - y * cx) / area, (y * bx - x * by) / area
                if s < -1e-9 or t < -1e-9 or s + t > 1.0 + 1e-9:
                    continue
                r = 1.0 - s - t
                depth = r * corners[a, 2] + s * corners[b, 2] + t * corners[c, 2]
                if depth < nearest[row, column]:
                    nearest[row, column] = depth
                    for channel in range(3):
                        value = r * colors[a, channel] + s * colors[b, channel] + t * colors[c, channel]
                        image[row, column, channel] = min(255.0, value * shade[face])
