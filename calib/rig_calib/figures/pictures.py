"""Pictures of the report as BGR images: matches on a pair of cameras, and the rig's surfaces from above."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.evidence import EdgeEvidence
from rig_calib.fusion.surface import Surface
from rig_calib.overlap import Region
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]

# Blue and orange stay apart for every kind of colour vision; marks differ in shape as well. BGR.
_KEPT, _REJECTED = (255, 190, 60), (40, 130, 255)
_PAPER = (250, 250, 250)
PAIR_COLORS = ((200, 110, 20), (30, 110, 230))
"""Of the first and the second camera of a pair, BGR."""

_MAX_LINES = 70  # more would cover the images
_PAIR_HEIGHT_PX, _MAX_SCALE, _GAP_PX = 560, 3.0, 6


def match_picture(
    evidence: EdgeEvidence,
    images: tuple[ImageU8, ImageU8],
    regions: tuple[Region, Region],
    portrait: bool,
    i_is_left: bool,
) -> ImageU8:
    """What both cameras see of their overlap, upright side by side, with the matches.

    Kept ones are dots, some with a line; rejected ones are crosses. `regions` are the parts of the images.
    """
    parts = [_cut(image, region) for image, region in zip(images, regions, strict=True)]
    pixels = [
        upright_pixels(seen - (region.left, region.top), part, portrait)
        for seen, region, part in zip((evidence.pixels_i, evidence.pixels_j), regions, parts, strict=True)
    ]
    parts = [upright(part, portrait) for part in parts]
    scale = min(_PAIR_HEIGHT_PX / max(part.shape[0] for part in parts), _MAX_SCALE)
    parts = [_resized(part, scale) for part in parts]
    order = (0, 1) if i_is_left else (1, 0)
    canvas, offset = _side_by_side(parts[order[0]], parts[order[1]])
    shifts = (0.0, offset) if i_is_left else (offset, 0.0)
    ends = [(seen + 0.5) * scale - 0.5 + (shift, 0.0) for seen, shift in zip(pixels, shifts, strict=True)]
    shown = regions[0].contains(evidence.pixels_i) & regions[1].contains(evidence.pixels_j)
    _draw_matches(canvas, ends[0][shown], ends[1][shown], evidence.inlier[shown])
    return canvas


@dataclass(frozen=True, slots=True)
class SliceStyle:
    """Size of the longer side, width of the pen, and half the thickness of the slice through the room."""

    size_px: int = 700
    pen_px: int = 2
    half_height_m: float = 0.25


def slice_picture(
    surfaces: Sequence[Surface],
    poses: Mapping[int, Pose],
    T_rig_view: Pose,
    limits: Array,
    colors: Sequence[tuple[int, int, int]] | None = None,
    style: SliceStyle = SliceStyle(),
) -> ImageU8:
    """Walls at the height of the cameras from above, a colour for each camera, on white.

    `limits` (2,2): least and greatest x, y of the view frame. Where cameras agree their lines coincide.
    """
    scale = style.size_px / float((limits[1] - limits[0]).max())
    image = np.full((*_page_shape(limits, scale), 3), 255, np.uint8)
    for k, surface in enumerate(surfaces):
        points = transform_points(inverse(T_rig_view), surface.points_at(poses[surface.camera_id]))
        rows, columns = _page_pixels(points[np.abs(points[:, 2]) < style.half_height_m], limits, scale)
        layer = np.full_like(image, 255)
        layer[rows, columns] = colors[k] if colors else camera_color(k, len(surfaces))
        pen = np.ones((style.pen_px, style.pen_px), np.uint8)
        image = np.minimum(image, cv2.erode(layer, pen))  # darker where lines cross
    return image


def view_limits(surfaces: Iterable[Surface], poses: Mapping[int, Pose], T_rig_view: Pose) -> Array:
    """Limits (2,2), x and y of the view frame, that hold nearly all points of the surfaces."""
    T_view_rig = inverse(T_rig_view)
    points = [transform_points(T_view_rig, s.points_at(poses[s.camera_id])[::7])[:, :2] for s in surfaces]
    low, high = np.percentile(np.concatenate([*points, np.zeros((1, 2))]), (0.5, 99.5), axis=0)
    return np.stack([low - 0.15, high + 0.15])


def camera_color(index: int, count: int) -> tuple[int, int, int]:
    """A hue (BGR) for each camera, neighbours far apart on the colour circle."""
    hue = (index * 0.382 * 180) % 180 if count > 3 else index * 60
    b, g, r = cv2.cvtColor(np.array([[[hue, 230, 190]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return int(b), int(g), int(r)


def encode_jpeg(image: ImageU8, quality: int = 82) -> bytes:
    """The image as JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def encode_png(image: ImageU8) -> bytes:
    """The image as PNG, for drawings with few colours."""
    return cv2.imencode(".png", image)[1].tobytes()


def _cut(image: ImageU8, region: Region) -> ImageU8:
    return image[max(region.top, 0) : region.bottom, max(region.left, 0) : region.right]


def _resized(image: ImageU8, scale: float) -> ImageU8:
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=how), dtype=np.uint8)


def upright(image: ImageU8, portrait: bool) -> ImageU8:
    """BGR as the world stands: a portrait camera's image x points down."""
    color = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.rotate(color, cv2.ROTATE_90_CLOCKWISE) if portrait else color, dtype=np.uint8)


def upright_pixels(pixels: Array, image: ImageU8, portrait: bool) -> Array:
    """Pixels (N,2) of an image as delivered on that image upright."""
    if not portrait:
        return pixels
    return np.column_stack([image.shape[0] - 1 - pixels[:, 1], pixels[:, 0]])


def _side_by_side(left: ImageU8, right: ImageU8) -> tuple[ImageU8, float]:
    height, offset = max(left.shape[0], right.shape[0]), left.shape[1] + _GAP_PX
    canvas = np.full((height, offset + right.shape[1], 3), _PAPER, np.uint8)
    canvas[: left.shape[0], : left.shape[1]] = left
    canvas[: right.shape[0], offset:] = right
    return canvas, float(offset)


def _draw_matches(canvas: ImageU8, ends_i: Array, ends_j: Array, inlier: npt.NDArray[np.bool_]) -> None:
    for kept, color in ((False, _REJECTED), (True, _KEPT)):
        chosen = np.flatnonzero(inlier == kept)
        lined = set(chosen[:: max(1, len(chosen) // _MAX_LINES)].tolist()) if kept else set()
        for k in chosen:
            a, b = (tuple(round(float(c)) for c in ends[k]) for ends in (ends_i, ends_j))
            if k in lined:
                cv2.line(canvas, a, b, color, 1, cv2.LINE_AA)
            for point in (a, b):
                if kept:
                    cv2.circle(canvas, point, 2, color, -1, cv2.LINE_AA)
                else:
                    cv2.drawMarker(canvas, point, color, cv2.MARKER_TILTED_CROSS, 8, 2, cv2.LINE_AA)


def _page_shape(limits: Array, scale: float) -> tuple[int, int]:
    extent = limits[1] - limits[0]
    return max(1, int(extent[0] * scale)), max(1, int(extent[1] * scale))


def _page_pixels(
    points: Array, limits: Array, scale: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of the points that fall on the page; x is up, y to the left."""
    height, width = _page_shape(limits, scale)
    rows = ((limits[1, 0] - points[:, 0]) * scale).astype(np.intp)
    columns = ((limits[1, 1] - points[:, 1]) * scale).astype(np.intp)
    shown = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return rows[shown], columns[shown]
