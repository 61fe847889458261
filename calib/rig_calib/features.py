"""Keypoints with descriptors (SIFT, Lowe 2004) of one camera's colour images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.overlap import Region
from rig_protocol.frames import ImageU8

Array = npt.NDArray[np.float64]

_BORDER_PX = 24  # SIFT looks at a neighbourhood; a cropped region brings it along
_SAME_PLACE_PX = 0.01
_TILE_PX, _LEAST_OF_TILE = 160, 60  # so many of the strongest keypoints come from every tile at least
_COARSE_SHARE = 6  # half the size holds fewer keypoints, and patches need but a start
# A blob is placed to a share of its size (0.05 on two renderers' images, where nothing else is wrong).
_POSITION_SHARE_OF_SCALE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of one image: pixels (N,2), information on them (N,2,2) in 1/px², descriptors (N,128) f32.

    SIFT describes a place once for every dominant orientation; `place` (N,) numbers the distinct places.
    """

    pixels: Array
    information: Array
    descriptors: npt.NDArray[np.float32]
    place: npt.NDArray[np.intp]

    def __len__(self) -> int:
        """How many keypoints there are."""
        return len(self.pixels)

    @property
    def has_place(self) -> npt.NDArray[np.bool_]:
        """(N,) where anything is known of the pixel."""
        return np.asarray(np.trace(self.information, axis1=1, axis2=2) > 0.0)


def mean_grey(images: Sequence[ImageU8]) -> ImageU8:
    """One grey image (H,W) of K grey or BGR images of a scene at rest: less noise, same place."""
    grey = [image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
    if len(grey) == 1:
        return np.asarray(grey[0], dtype=np.uint8)
    return np.rint(np.mean(np.stack(grey), axis=0, dtype=np.float64)).astype(np.uint8)


def detect_coarsely(
    image: ImageU8, regions: Sequence[Region], max_keypoints: int, pixel_sigma: float
) -> Keypoints:
    """A share of the keypoints, spread over the regions, found at half the image's size: a quick start.

    The regions are apart. The pixels are those of the whole image.
    """
    half = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    parts = [part for region in regions for part in _halved(region).tiles(_TILE_PX)]
    each = max(max_keypoints // _COARSE_SHARE // max(len(parts), 1), _LEAST_OF_TILE)
    found = _joined([detect(half, part, each, pixel_sigma) for part in parts])
    # The centre of a pixel of half the size lies between four.
    return replace(found, pixels=2.0 * found.pixels + 0.5, information=0.25 * found.information)


def detect(image: ImageU8, region: Region, max_keypoints: int, pixel_sigma: float) -> Keypoints:
    """The strongest SIFT keypoints of the region of a grey image, in the image's pixels.

    `pixel_sigma` is the standard deviation of a small one's place, pixels; large ones are placed less well.
    """
    top, left = max(region.top - _BORDER_PX, 0), max(region.left - _BORDER_PX, 0)
    crop = np.ascontiguousarray(image[top : region.bottom + _BORDER_PX, left : region.right + _BORDER_PX])
    # Without the precise upscale OpenCV's positions are shifted by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=max_keypoints, enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(crop, None)
    if not found:
        return _no_keypoints()
    pixels = np.array([keypoint.pt for keypoint in found], dtype=np.float64)
    pixels += (left, top)
    scale_px = np.array([keypoint.size / 2.0 for keypoint in found])
    # OpenCV finds keypoints in parallel: their order, not their values, may change from run to run.
    angles = np.array([keypoint.angle for keypoint in found])
    order = np.lexsort((angles, scale_px, pixels[:, 1], pixels[:, 0]))
    order = order[region.contains(pixels[order])]
    pixels = pixels[order]
    variance = pixel_sigma**2 + (_POSITION_SHARE_OF_SCALE * scale_px[order]) ** 2
    information = np.eye(2) / variance[:, None, None]
    return Keypoints(pixels, information, descriptors[order].astype(np.float32), _places(pixels))


def _halved(region: Region) -> Region:
    return Region(region.left // 2, region.top // 2, (region.right + 1) // 2, (region.bottom + 1) // 2)


def _joined(parts: Sequence[Keypoints]) -> Keypoints:
    """The keypoints of several parts of an image, no place of which is in two."""
    if not parts:
        return _no_keypoints()
    first = np.cumsum([0] + [int(part.place.max(initial=-1)) + 1 for part in parts])
    return Keypoints(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.information for part in parts]),
        np.concatenate([part.descriptors for part in parts]),
        np.concatenate([part.place + start for part, start in zip(parts, first, strict=False)]),
    )


def _places(pixels: Array) -> npt.NDArray[np.intp]:
    moved = (np.abs(np.diff(pixels, axis=0)) > _SAME_PLACE_PX).any(axis=1)
    return np.concatenate([[0], np.cumsum(moved)]).astype(np.intp)[: len(pixels)]


def _no_keypoints() -> Keypoints:
    nothing = np.empty((0, 128), dtype=np.float32)
    return Keypoints(np.empty((0, 2)), np.empty((0, 2, 2)), nothing, np.empty(0, dtype=np.intp))
