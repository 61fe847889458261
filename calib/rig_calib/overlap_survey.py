"""What two cameras deliver where their views overlap: the causes of an overlap without support."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rig_calib.depth_model import depth_grid, depth_of_disparity, disparity_image
from rig_calib.observed_camera import missing_images
from rig_calib.overlap import Region
from rig_calib.view import CameraView

_LITTLE_DEPTH = 0.2  # of the pixels: an ordinary room fills more than half
_DARK, _BRIGHT = 20.0, 235.0  # mean grey value: descriptors see nothing beyond
# Something this much nearer than what the other camera sees, and this near, is no wall seen askew.
_HIDING_SHARE, _HIDING_M = 0.6, 1.2


@dataclass(frozen=True, slots=True)
class OverlapSide:
    """One camera's part of an overlap: grey value, share of pixels with depth, their median depth."""

    brightness: float
    depth_share: float
    depth_m: float


def survey(view: CameraView, region: Region) -> OverlapSide:
    """Look at a region of a view's newest colour image, and at the like part of its depth image.

    Both images cover about the same field of view; a survey needs no more.
    """
    color = view.color[-1]
    seen = color[region.top : region.bottom, region.left : region.right]
    disparity = disparity_image(view, (len(view.raw) or len(view.depth_mm)) - 1)
    rows, columns = (
        slice(low * size // total, high * size // total)
        for low, high, size, total in (
            (region.top, region.bottom, disparity.shape[0], color.shape[0]),
            (region.left, region.right, disparity.shape[1], color.shape[1]),
        )
    )
    there = disparity[rows, columns]
    known = there[np.isfinite(there)]
    depth_m = depth_of_disparity(depth_grid(view.model, view.depth_frame).raw_model, known)
    return OverlapSide(
        brightness=float(seen.mean()) if seen.size else 0.0,
        depth_share=len(known) / max(there.size, 1),
        depth_m=float(np.median(depth_m)) if len(known) else np.inf,
    )


def obstacle(views: Mapping[int, CameraView], regions: Mapping[int, Region]) -> str | None:
    """What keeps two cameras from seeing the same things, in words; None when nothing shows.

    `regions` are the two parts of the overlap by camera id.
    """
    for camera_id in regions:
        view = views[camera_id]
        absent = missing_images(view) or (None if view.raw or view.depth_mm else "no depth image")
        if absent is not None:
            return f"{view.name} delivers {absent}: see that it streams"
    sides = {camera_id: survey(views[camera_id], region) for camera_id, region in regions.items()}
    for camera_id, side in sides.items():
        told = _fault(views[camera_id].name, side)
        if told is not None:
            return told
    near, far = sorted(sides, key=lambda camera_id: sides[camera_id].depth_m)
    if sides[near].depth_m < min(_HIDING_M, _HIDING_SHARE * sides[far].depth_m):
        return (
            f"something {sides[near].depth_m:.1f} m in front of {views[near].name} hides what "
            f"{views[far].name} sees: move it"
        )
    return None


def _fault(name: str, side: OverlapSide) -> str | None:
    if side.brightness < _DARK:
        return f"{name} sees only darkness there: switch on a light, or take away what covers the lens"
    if side.brightness > _BRIGHT:
        return f"{name} is dazzled there: draw the curtain, or turn the lamp away"
    if side.depth_share < _LITTLE_DEPTH:
        return (
            f"{name} delivers no depth there: move what stands closer than 0.5 m, "
            "cover glass, mirrors and what the sun shines on"
        )
    return None
