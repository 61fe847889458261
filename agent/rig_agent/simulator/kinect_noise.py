"""How a Kinect's depth camera spoils what it sees: distortion, correlated noise, holes, rounding.

What stays the same over frames is made once; a frame then costs a few passes over the image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np
import numpy.typing as npt

from rig_agent.simulator.lens import Plane
from rig_agent.simulator.noise_bank import NoiseBank, correlated_noise
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.camera import RawDepthModel
from rig_protocol.frames import NO_DISPARITY, ImageU16

Mask = npt.NDArray[np.bool_]

BLIND_COLUMNS = 8  # right-hand columns that the correlation window never covers
MIN_Z_M, MAX_Z_M = 0.5, 5.0
STEEPEST_DEG = 80.0
_LEAST_COSINE = np.cos(np.deg2rad(STEEPEST_DEG))

_ROUNDING_VARIANCE = 1 / 12  # of a uniform step of one LSB
_EDGE_JITTER_PX = 0.8  # lateral noise of Nguyen, Izadi & Lovell 2012
_EDGE_STEP = 0.03  # relative change of 1/z over five pixels that only an edge makes
# How distortion decays with disparity: Herrera, Kannala & Heikkila 2012.
_DECAY_0, _DECAY_1 = 1.791, 0.002926
_DISTORTION_QUOTED_AT_M = 1.5
_UNITS_DIFFER = 0.2  # in how much they distort, natural logarithm
_FROZEN_HOLES = 0.7  # interference flickers at the rims of holes that mostly stay


@dataclass(frozen=True, slots=True, eq=False)
class CleanDepth:
    """What an ideal depth camera of the same place sees; all (rows, columns).

    `interfered`: where any neighbour's projector reaches; `lit`: where each of them does.
    """

    z_m: Plane
    cosine: Plane
    shadow: Mask
    interfered: Mask
    lit: tuple[Mask, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class DepthPatch:
    """What is seen on a window (rows, columns) of the image instead of the still scene."""

    window: tuple[slice, slice]
    clean: CleanDepth


NOBODY: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class _Interference:
    """What neighbours' dots do: no depth where `holes` is positive, `error` (LSB) on the disparity."""

    holes: Plane | None
    error: Plane | None

    def within(self, lit: Mask) -> "_Interference":
        """The same where there is light, nothing elsewhere."""
        if not lit.any():
            return _Interference(None, None)
        holes, error = self.holes, self.error
        return _Interference(
            None if holes is None else np.where(lit, holes, np.float32(-100)),
            None if error is None else np.where(lit, error, np.float32(0)),
        )


class DisparitySensor:
    """Raw disparity frames of one unit in front of one still scene."""

    def __init__(
        self,
        rng: np.random.Generator,
        clean: CleanDepth,
        raw_model: RawDepthModel,
        settings: SimulatorSettings,
    ) -> None:
        """Draw the unit's distortion and frozen noise; `raw_model` is its true one."""
        shape = clean.z_m.shape[0], clean.z_m.shape[1]
        self.clean = clean
        self._raw_model, self._settings = raw_model, settings
        self._jitter = correlated_noise(rng, shape), correlated_noise(rng, shape)
        self._distortion = smooth_field(rng, shape)
        self._distortion_scale = float(np.exp(_UNITS_DIFFER * rng.standard_normal()))
        self._frozen = np.sqrt(settings.frozen_noise) * correlated_noise(rng, shape)
        self._base, self._fresh_sigma, self._invalid = self._measured(DepthPatch(np.s_[:, :], clean))
        self._bank = NoiseBank(rng, shape, correlated=True)
        self._interference = {
            NOBODY: _Interference(
                _hole_field(rng, clean.interfered, settings.interference),
                _dot_error(rng, clean.interfered, settings.interference_noise_lsb),
            )
        }

    def frame(
        self, rng: np.random.Generator, patches: Sequence[DepthPatch] = (), dark: frozenset[int] = NOBODY
    ) -> ImageU16:
        """One frame, 11 bit, 2047 = none; `patches`: where something stands in front of the scene.

        `dark`: which of the projectors in `clean.lit` are off.
        """
        base, sigma, invalid = self._base, self._fresh_sigma, self._invalid
        if patches:
            base, sigma, invalid = base.copy(), sigma.copy(), invalid.copy()
        for patch in patches:
            base[patch.window], sigma[patch.window], invalid[patch.window] = self._measured(patch)
        interference = self._interference_without(dark)
        if interference.error is not None:
            base = base + interference.error
        measured = cv2.add(base, cv2.multiply(sigma, self._bank.draw(rng)), dtype=cv2.CV_16U)
        raw: ImageU16 = np.asarray(measured, dtype=np.uint16)
        raw[invalid] = NO_DISPARITY
        raw[:, -BLIND_COLUMNS:] = NO_DISPARITY
        if interference.holes is not None:
            flicker = self._bank.draw(rng)
            raw[cv2.scaleAdd(flicker, np.sqrt(1 - _FROZEN_HOLES), interference.holes) > 0] = NO_DISPARITY
        return raw

    def _interference_without(self, dark: frozenset[int]) -> "_Interference":
        """What is left of it while some projectors are off."""
        if dark not in self._interference:
            shining = [mask for k, mask in enumerate(self.clean.lit) if k not in dark]
            lit = np.logical_or.reduce(shining) if shining else np.zeros_like(self.clean.interfered)
            self._interference[dark] = self._interference[NOBODY].within(lit)
        return self._interference[dark]

    def _measured(self, patch: DepthPatch) -> tuple[Plane, Plane, Mask]:
        """On a window: disparity without fresh noise, the sigma of that, and where nothing is measured."""
        window, clean, settings, model = patch.window, patch.clean, self._settings, self._raw_model
        z_m = np.clip(
            _with_ragged_edges(clean.z_m, (self._jitter[0][window], self._jitter[1][window])), 0.1, 50
        )
        ideal = model.offset - model.numerator_m / z_m
        amplitude = distortion_amplitude(settings, model, ideal) * self._distortion_scale
        sigma = noise_sigma_lsb(settings, model, z_m, clean.cosine)
        base = ideal + self._distortion[window] * amplitude + sigma * self._frozen[window]
        invalid = clean.shadow | (z_m < MIN_Z_M) | (z_m > MAX_Z_M) | (clean.cosine < _LEAST_COSINE)
        fresh_sigma = np.asarray(sigma * np.sqrt(1 - settings.frozen_noise), dtype=np.float32)
        return np.asarray(base, dtype=np.float32), fresh_sigma, invalid


def noise_sigma_lsb(
    settings: SimulatorSettings, raw_model: RawDepthModel, z_m: Plane, cosine: Plane
) -> Plane:
    """Noise before rounding: constant in disparity, plus axial noise that grows with the angle of incidence.

    The second term is 1e-4/√z · θ²/(π/2 − θ)² metres (Nguyen, Izadi & Lovell 2012).
    """
    constant = np.sqrt(max(settings.disparity_noise_lsb**2 - _ROUNDING_VARIANCE, 0.0))
    angle = np.minimum(np.arccos(np.clip(cosine, 0, 1)), np.deg2rad(STEEPEST_DEG))
    slanted_m = 1e-4 / np.sqrt(z_m) * (angle / (np.pi / 2 - angle)) ** 2
    return np.asarray(constant + slanted_m * raw_model.numerator_m / z_m**2, dtype=np.float32)


def smooth_field(rng: np.random.Generator, shape: tuple[int, int]) -> Plane:
    """A low-frequency field over the image with peak to peak 1 and mean 0: a few long waves and a bowl."""
    v, u = np.mgrid[-1:1:48j, -1:1:64j]
    waves = rng.uniform(0.2, 0.7, (4, 1, 1)), rng.uniform(0, 2 * np.pi, (2, 4, 1, 1))
    heading, phase = waves[1]
    field = np.cos(np.pi * waves[0] * (np.cos(heading) * u + np.sin(heading) * v) + phase).sum(axis=0)
    field += rng.uniform(-1.5, 1.5) * (u**2 + v**2)
    field = (field - field.mean()) / np.ptp(field)
    return np.asarray(cv2.resize(field.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC))


def distortion_amplitude(settings: SimulatorSettings, raw_model: RawDepthModel, disparity: Plane) -> Plane:
    """Peak to peak of a typical unit's distortion, LSB, at each pixel's disparity."""

    def decay(d: Plane | float) -> npt.NDArray[np.floating]:
        return np.asarray(np.exp(_DECAY_0 - _DECAY_1 * d))

    lsb_per_m = raw_model.numerator_m / _DISTORTION_QUOTED_AT_M**2
    quoted_disparity = raw_model.offset - raw_model.numerator_m / _DISTORTION_QUOTED_AT_M
    quoted_lsb = settings.depth_distortion_mm / 1000 * lsb_per_m
    return np.asarray(quoted_lsb * decay(disparity) / decay(quoted_disparity), dtype=np.float32)


def _with_ragged_edges(z_m: Plane, jitter: tuple[Plane, Plane]) -> Plane:
    """Depth whose edges wander by the lateral noise; smooth surfaces stay."""
    near = np.ones((5, 5), np.uint8)
    inverse = 1 / np.maximum(z_m, 1e-3)
    edge = cv2.dilate(inverse, near) - cv2.erode(inverse, near) > _EDGE_STEP * inverse
    rows, columns = np.nonzero(edge)
    moved = [
        np.clip(index + np.rint(_EDGE_JITTER_PX * shift[rows, columns]).astype(int), 0, size - 1)
        for index, shift, size in zip((rows, columns), jitter, z_m.shape, strict=True)
    ]
    ragged = z_m.copy()
    ragged[rows, columns] = z_m[moved[0], moved[1]]
    return ragged


def _dot_error(rng: np.random.Generator, interfered: Mask, sigma_lsb: float) -> Plane | None:
    """What foreign dots in the correlation window add to the disparity.

    Both patterns stand still, and so does the error: averaging frames does not help against it.
    """
    if sigma_lsb <= 0 or not interfered.any():
        return None
    field = sigma_lsb * correlated_noise(rng, (interfered.shape[0], interfered.shape[1]))
    return np.asarray(np.where(interfered, field, 0), dtype=np.float32)


def _hole_field(rng: np.random.Generator, interfered: Mask, share: float) -> Plane | None:
    """Positive with probability `share` once flicker is added, where the neighbours' projectors reach."""
    if share <= 0 or not interfered.any():
        return None
    shape = interfered.shape[0], interfered.shape[1]
    field = np.sqrt(_FROZEN_HOLES) * correlated_noise(rng, shape) - NormalDist().inv_cdf(1 - share)
    return np.asarray(np.where(interfered, field, -100), dtype=np.float32)
