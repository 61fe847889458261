"""Images for codec tests: seeded, of every kind, from easy to hostile."""

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.codecs import ImageKind

Image = npt.NDArray[np.generic]

CHANNELS = {"bgr": (3,)}
DEPTH_KINDS = ("raw", "depth_mm")


def empty_of(kind: ImageKind, height: int, width: int) -> Image:
    """All zeros, in the shape and type of this kind."""
    dtype = np.uint16 if kind in DEPTH_KINDS else np.uint8
    return np.zeros((height, width, *CHANNELS.get(kind, ())), dtype)


def largest_value(kind: ImageKind) -> int:
    """The largest pixel that an image of this kind may hold."""
    return {"raw": 2047, "depth_mm": 65535}.get(kind, 255)


def noise(kind: ImageKind, height: int, width: int, seed: int = 0) -> Image:
    """Every value equally likely: nothing to predict."""
    image = empty_of(kind, height, width)
    values = np.random.default_rng(seed).integers(0, largest_value(kind), image.shape, endpoint=True)
    return values.astype(image.dtype)


def scene(kind: ImageKind, height: int, width: int, seed: int = 0) -> Image:
    """Slopes, an edge, a little noise and, in depth, holes: what sensors see."""
    generator = np.random.default_rng(seed)
    image = empty_of(kind, height, width)
    y, x = np.mgrid[:height, :width]
    surface = 40 + 0.1 * x + 0.2 * y + 30 * (x > width // 2)
    if image.ndim == 3:
        surface = surface[..., np.newaxis]
    surface = surface + generator.normal(0, 1, image.shape)
    if kind not in DEPTH_KINDS:
        return surface.clip(0, 255).astype(np.uint8)
    if kind == "raw":
        values, none = surface + 500, 2047
    else:
        values, none = 11 * surface, 0
    values[
        generator.random((-(-height // 8), -(-width // 8))).repeat(8, 0).repeat(8, 1)[:height, :width] < 0.3
    ] = none
    return values.astype(np.uint16)


def mosaic(bgr: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The GRBG image that a sensor would have seen: one channel of each pixel."""
    bayer = np.empty(bgr.shape[:2], np.uint8)
    for row, column, channel in ((0, 0, 1), (0, 1, 2), (1, 0, 0), (1, 1, 1)):
        bayer[row::2, column::2] = bgr[row::2, column::2, channel]
    return bayer


def read_image(path: object) -> npt.NDArray[np.generic]:
    """A PNG as it is stored."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image
