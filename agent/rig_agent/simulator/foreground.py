"""What people change in a view of the still room: they cover it, and keep lamp and projector off it.

Only the windows that they reach are rendered, so that a frame with people costs some milliseconds. A person
is taken to be nearer than anything else in the colour image: nobody walks behind furniture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from rig_agent.simulator.color_sensor import ColorPatch
from rig_agent.simulator.kinect_noise import CleanDepth, DepthPatch
from rig_agent.simulator.lens import Plane, RayGrid, ray_grid
from rig_agent.simulator.people import Standing
from rig_agent.simulator.renderer import NOTHING, cast, cosine_of_incidence, shade, surface_normals
from rig_agent.simulator.scene import Scene
from rig_agent.simulator.surface import left_in_shadow
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, transform_points

Window = tuple[slice, slice]
Vector = npt.NDArray[np.float64]

PROJECTOR_BASELINE_M = 0.075
"""The projector sits to the right of the depth camera."""

_NEAR_M = 0.2
_LENS_REACH_PX = 4  # beyond a person's outline
_COARSE_PX = 8  # a lamp's shadow has no sharp rim
_PENUMBRA_PX = 1.0  # of the coarse image


@dataclass(frozen=True, slots=True, eq=False)
class LampLight:
    """Points (rows, columns, 3) of a still scene, and the share of light that each keeps in a shadow."""

    points: Vector
    left: Vector
    light: Vector
    size: tuple[int, int]

    @classmethod
    def on(cls, scene: Scene, camera: Intrinsics, T_room_color: Pose) -> "LampLight":
        """Of the scene that a colour camera sees."""
        coarse = replace(
            camera,
            fx=camera.fx / _COARSE_PX,
            fy=camera.fy / _COARSE_PX,
            cx=(camera.cx + 0.5) / _COARSE_PX - 0.5,
            cy=(camera.cy + 0.5) / _COARSE_PX - 0.5,
            width=camera.width // _COARSE_PX,
            height=camera.height // _COARSE_PX,
        )
        rays = ray_grid(coarse)
        hits = cast(scene.surfaces, T_room_color, rays)
        z = 1 / np.where(hits.surface != NOTHING, hits.inverse_z, 1).astype(np.float64)
        seen = np.stack([rays.x * z, rays.y * z, z], axis=-1)
        points = transform_points(T_room_color, seen)
        left = left_in_shadow(points, surface_normals(scene.surfaces)[hits.surface], scene.light)
        return cls(points, left, scene.light, (camera.width, camera.height))

    def left_by(self, people: Sequence[Standing]) -> Plane | None:
        """Share (rows, columns) of the light that people leave; None where they throw no shadow."""
        blocked = np.zeros(self.left.size, bool)
        for person in people:
            blocked |= person.blocks(self.points.reshape(-1, 3), self.light)
        if not blocked.any():
            return None
        left = np.where(blocked.reshape(self.left.shape), self.left, 1.0).astype(np.float32)
        soft = cv2.GaussianBlur(left, (0, 0), _PENUMBRA_PX)
        return np.asarray(cv2.resize(soft, self.size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def color_patches(
    scene: Scene, people: Sequence[Standing], T_room_color: Pose, rays: RayGrid, samples: int
) -> list[ColorPatch]:
    """What covers the colour image, farthest first; `rays` has samples × samples a pixel."""
    patches = []
    for person in sorted(people, key=lambda one: -_distance_m(one, T_room_color)):
        pixels = _window(person, T_room_color, rays, samples, (_LENS_REACH_PX, _LENS_REACH_PX))
        if pixels is None:
            continue
        part = _crop(rays, _scaled(pixels, samples))
        hits = cast(person.surfaces, T_room_color, part)
        clothed = replace(scene, seed=person.texture_seed, surfaces=person.surfaces)
        image = shade(clothed, hits, T_room_color, part)
        patches.append(ColorPatch(pixels, image, (hits.surface != NOTHING).astype(np.float32)))
    return patches


def depth_patches(
    still: CleanDepth, people: Sequence[Standing], T_room_depth: Pose, rays: RayGrid, T_room_projector: Pose
) -> list[DepthPatch]:
    """What covers the depth image, and the shadows that people throw in the projector's light."""
    patches: list[DepthPatch] = []
    seen = still
    for person in people:
        window = _window(person, T_room_depth, rays, 1, (0, _longest_shadow_px(person, T_room_depth, rays)))
        if window is None:
            continue
        part = _crop(rays, window)
        hits = cast(person.surfaces, T_room_depth, part)
        z_m = np.where(hits.surface != NOTHING, 1 / np.maximum(hits.inverse_z, 1e-6), np.inf)
        covered = (z_m < seen.z_m[window]) | (np.isfinite(z_m) & (seen.z_m[window] == 0))
        z_m = np.where(covered, z_m, seen.z_m[window]).astype(np.float32)
        cosine = cosine_of_incidence(person.surfaces, hits, T_room_depth, part)
        points = np.stack([part.x * z_m, part.y * z_m, z_m], axis=-1).reshape(-1, 3).astype(np.float64)
        shadow = person.blocks(transform_points(T_room_depth, points), T_room_projector[:3, 3])
        clean = CleanDepth(
            z_m,
            np.where(covered, cosine, seen.cosine[window]),
            shadow.reshape(z_m.shape) & ~covered | seen.shadow[window] & ~covered,
            seen.interfered[window],
        )
        patches.append(DepthPatch(window, clean))
        seen = _pasted(seen, patches[-1])
    return patches


def _pasted(seen: CleanDepth, patch: DepthPatch) -> CleanDepth:
    """The whole image with a patch in it: people may stand before one another."""
    z_m, cosine, shadow = seen.z_m.copy(), seen.cosine.copy(), seen.shadow.copy()
    z_m[patch.window], cosine[patch.window] = patch.clean.z_m, patch.clean.cosine
    shadow[patch.window] = patch.clean.shadow
    return CleanDepth(z_m, cosine, shadow, seen.interfered)


def _distance_m(person: Standing, T_room_camera: Pose) -> float:
    return float(np.linalg.norm(person.T_room_person[:2, 3] - T_room_camera[:2, 3]))


def _longest_shadow_px(person: Standing, T_room_depth: Pose, rays: RayGrid) -> int:
    """f·b/z: by so many columns a shadow on a far wall lies beside who throws it."""
    nearest_m = max(_distance_m(person, T_room_depth) - 0.3, 0.4)
    return int(np.ceil(PROJECTOR_BASELINE_M / nearest_m / rays.spacing))


def _window(
    person: Standing, T_room_camera: Pose, rays: RayGrid, samples: int, margin_px: tuple[int, int]
) -> Window | None:
    """Pixels that a person may cover, from even ones on, and a margin (rows, columns) about them."""
    corners = transform_points(inverse(T_room_camera), person.corners)
    corners = corners[corners[:, 2] > _NEAR_M]
    if not len(corners):
        return None
    flat = corners[:, :2] / corners[:, 2:]
    found = rays.window(flat.min(axis=0), flat.max(axis=0))
    if found is None:
        return None
    rows, columns = (
        slice(max(part.start // samples - margin, 0) // 2 * 2, min(-(-part.stop // samples) + margin, size))
        for part, margin, size in zip(
            found, margin_px, (rays.shape[0] // samples, rays.shape[1] // samples), strict=True
        )
    )
    return rows, columns


def _scaled(window: Window, samples: int) -> Window:
    rows, columns = (slice(part.start * samples, part.stop * samples) for part in window)
    return rows, columns


def _crop(rays: RayGrid, window: Window) -> RayGrid:
    return RayGrid.of(*rays.crop(window))
