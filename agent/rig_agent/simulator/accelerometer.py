"""A Kinect's accelerometer: which way a unit feels down, with an error of its own and noise."""

import numpy as np
import numpy.typing as npt

from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.streams import Stream, generator

Vector = npt.NDArray[np.float64]

# KXSD9 data sheet: sensitivity within 3 %. A reading at rest scatters by 3 mg; told is the mean of ten.
_SCALE_ERROR, _NOISE_G = 0.01, 0.003 / np.sqrt(10)


def felt_acceleration(settings: SimulatorSettings, camera: int, moment: int, down: Vector) -> Vector:
    """What a unit at rest feels, g, where `down` (3,) is the true direction in its colour camera's frame.

    A zero-g offset and an error of scale an axis, which are the unit's own and stay, and noise.
    """
    unit = generator(settings.seed, Stream.ACCELEROMETER, camera)
    offset = np.deg2rad(settings.accelerometer_deg) * unit.standard_normal(3)
    scale = 1 + _SCALE_ERROR * unit.standard_normal(3)
    noise = _NOISE_G * generator(settings.seed, Stream.ACCELEROMETER, camera, moment).standard_normal(3)
    return np.asarray(scale * down + offset + noise)
