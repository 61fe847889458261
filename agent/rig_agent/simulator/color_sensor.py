"""How a Kinect's colour camera spoils what it sees: soft lens, exposure, vignetting, mosaic, noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_agent.simulator.lens import Plane
from rig_agent.simulator.noise_bank import NoiseBank
from rig_protocol.frames import ImageU8

_MEAN_LEVEL = 105.0  # what automatic exposure aims at
_GAIN_LIMITS = (0.7, 2.5)
_BLUR_PX = 0.7  # of the lens, one sigma
_VIGNETTING = 0.15  # loss in the corners
_PHOTON_VARIANCE, _READ_SIGMA = 0.02, 1.0  # variance per level, levels

_GREEN, _BLUE, _RED = 1, 0, 2
_MOSAIC = ((_GREEN, _RED), (_BLUE, _GREEN))
"""Channel (of BGR) at even and odd rows and columns: GRBG."""


@dataclass(frozen=True, slots=True, eq=False)
class ColorPatch:
    """Something in front of the still scene, on a window (rows, columns) of the image.

    The window begins at even pixels. `image` and `covered` have samples × samples points a pixel: BGR, black
    where the still scene shows, and 1 where it does not.
    """

    window: tuple[slice, slice]
    image: ImageU8
    covered: Plane


class BayerSensor:
    """Bayer frames of one camera in front of one still scene."""

    def __init__(self, rng: np.random.Generator, scene: ImageU8, samples: int, exposure: float) -> None:
        """`scene`: BGR with samples × samples points a pixel; `exposure`: factor on the automatic one."""
        image = _through_lens(scene, samples)
        gain = np.clip(_MEAN_LEVEL / max(float(image.mean()), 1.0), *_GAIN_LIMITS) * exposure
        self._samples = samples
        self._gain = np.asarray(gain * _vignetting(image.shape[:2]))
        self._base = np.asarray(np.minimum(mosaic(image) * self._gain, 255), dtype=np.float32)
        self._sigma = _noise_sigma(self._base)
        self._bank = NoiseBank(rng, image.shape[:2], correlated=False)

    def frame(
        self, rng: np.random.Generator, light: Plane | None = None, patches: Sequence[ColorPatch] = ()
    ) -> ImageU8:
        """One frame, 8 bit GRBG; `light` (rows, columns): share of the scene's light that is left.

        `patches`: what stands in front of the scene, farthest first.
        """
        base, sigma = self._base, self._sigma
        if light is not None or patches:
            base = base.copy() if light is None else np.asarray(base * light, dtype=np.float32)
            for patch in patches:
                base[patch.window] = self._covered(base[patch.window], patch)
            sigma = _noise_sigma(base)
        noise = cv2.multiply(sigma, self._bank.draw(rng))
        return np.asarray(cv2.add(base, noise, dtype=cv2.CV_8U), dtype=np.uint8)

    def _covered(self, base: Plane, patch: ColorPatch) -> Plane:
        """The base of a window with the patch in front: the lens mixes both at the rim."""
        image = mosaic(_through_lens(patch.image, self._samples)) * self._gain[patch.window]
        share = _through_lens(patch.covered, self._samples)
        return np.asarray(np.minimum(base * (1 - share) + image, 255), dtype=np.float32)


def mosaic(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The samples (rows, columns) that a GRBG sensor takes of a BGR image."""
    out = np.empty(image.shape[:2], np.float32)
    for row, channels in enumerate(_MOSAIC):
        for column, channel in enumerate(channels):
            out[row::2, column::2] = image[row::2, column::2, channel]
    return out


def _noise_sigma(base: Plane) -> Plane:
    return np.asarray(np.sqrt(_PHOTON_VARIANCE * base + _READ_SIGMA**2), dtype=np.float32)


def _through_lens(scene: ImageU8 | Plane, samples: int) -> npt.NDArray[np.float32]:
    """The supersampled scene blurred by the lens and summed over the pixels' areas."""
    soft = cv2.GaussianBlur(scene, (0, 0), _BLUR_PX * samples)
    size = (scene.shape[1] // samples, scene.shape[0] // samples)
    return np.asarray(cv2.resize(soft, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _vignetting(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    y, x = (np.linspace(-1, 1, size) for size in shape)
    return 1 - _VIGNETTING * (x**2 + y[:, None] ** 2) / 2
