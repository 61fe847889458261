"""Look: what the watch keeps of one camera's frame, small and independent of exposure and shading."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.frames import NO_DISPARITY, ImageU8, ImageU16

Plane = npt.NDArray[np.float32]
Disparity = ImageU16 | Plane

HALF = 2
"""The colour image is halved: a cell of a Bayer image becomes one grey value, and noise is halved, too."""

GREY = 128
"""The level of no contrast."""

_SHADING_PX = 31  # what varies more slowly than this, halved pixels, is light and not texture
_LEVELS_PER_CONTRAST = 400.0  # 8 bits hold contrasts of ±32 %, in steps well below the noise of about 1 %
_DARK_LEVELS = 4.0  # keeps noise in black corners from looking like texture
_OUTLIER_STEPS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Local contrast of the halved colour image, u8, and disparity (H,W), u16 or f32, raw steps, 0 = none."""

    contrast: ImageU8
    disparity: Disparity


def look_at(color: ImageU8, disparity: Disparity) -> Look:
    """The look of a colour image (Bayer or grey (H,W), or BGR (H,W,3)) and a disparity image (0 = none)."""
    grey = color if color.ndim == 2 else cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    size = (grey.shape[1] // HALF, grey.shape[0] // HALF)
    level = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    shading = cv2.blur(level, (_SHADING_PX, _SHADING_PX)) + _DARK_LEVELS
    contrast = GREY + _LEVELS_PER_CONTRAST * (level / shading - 1)
    return Look(np.clip(np.rint(contrast), 0, 255).astype(np.uint8), disparity)


def known_disparity(raw: ImageU16) -> ImageU16:
    """Raw 11-bit disparity with 0 where there is none."""
    disparity = raw.copy()
    disparity[raw >= NO_DISPARITY] = 0
    return disparity


def full_pixels(halved: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Pixels of the colour image at pixels (N,2) of the halved one; centres are at integers in both."""
    return np.asarray(halved * HALF + (HALF - 1) / 2, dtype=np.float64)


def median_look(looks: Sequence[Look]) -> Look:
    """One look out of several, without what passed through fewer than half of them.

    The disparity is the mean of what is near the median, which is a whole number of steps.
    """
    contrast = np.median(np.stack([look.contrast for look in looks]), axis=0)
    stack = np.sort(np.stack([look.disparity for look in looks]), axis=0).astype(np.float32)
    count = (stack > 0).sum(axis=0)
    middle = np.take_along_axis(stack, (len(looks) - (count + 1) // 2).clip(0, len(looks) - 1)[None], axis=0)
    near = (np.abs(stack - middle) <= _OUTLIER_STEPS) & (stack > 0)
    mean = np.where(near, stack, 0).sum(axis=0) / np.maximum(near.sum(axis=0), 1)
    disparity = np.where(count * 2 >= len(looks), mean, 0).astype(np.float32)
    return Look(np.rint(contrast).astype(np.uint8), disparity)


def mean_look(looks: Sequence[Look]) -> Look:
    """The mean of several looks; disparity where at least half of them have it."""
    total = np.zeros(looks[0].contrast.shape, np.float32)
    disparity = np.zeros(looks[0].disparity.shape, np.float32)
    count = np.zeros(looks[0].disparity.shape, np.float32)
    for look in looks:
        cv2.accumulate(look.contrast, total)
        cv2.accumulate(look.disparity, disparity)
        cv2.accumulate((look.disparity > 0).view(np.uint8), count)
    mean = np.where(count * 2 >= len(looks), disparity / np.maximum(count, 1), 0).astype(np.float32)
    return Look(np.rint(total / len(looks)).astype(np.uint8), mean)
