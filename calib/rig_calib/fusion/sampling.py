"""Colour and values of images at sub-pixel positions."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.frames import ImageU8

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]


def mean_color(images: Sequence[ImageU8]) -> Array32:
    """Mean image (H,W,3), RGB, of BGR or grey images."""
    total = np.zeros((*images[0].shape[:2], 3), np.float32)
    for image in images:
        total += image[..., ::-1] if image.ndim == 3 else image[..., None]
    return np.asarray(total / len(images), dtype=np.float32)


def sample_colors(image: Array32, pixels: Array) -> ImageU8:
    """Colours (N,3) u8 of an image (H,W,3) at sub-pixel positions (N,2), bilinear."""
    return np.asarray(np.clip(np.rint(sample_image(image, pixels)), 0, 255), dtype=np.uint8)


def sample_image(image: Array32, pixels: Array) -> Array32:
    """Values (N,) or (N,C) of an image (H,W) or (H,W,C) at sub-pixel positions (N,2), bilinear.

    Beyond the border the border's value holds.
    """
    # remap takes no list longer than 32767, so that the list becomes a nearly square map.
    width = max(1, int(np.ceil(np.sqrt(len(pixels)))))
    maps = np.zeros((width, width, 2), np.float32)
    maps.reshape(-1, 2)[: len(pixels)] = pixels
    sampled = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled.reshape(width * width, *image.shape[2:])[: len(pixels)], dtype=np.float32)
