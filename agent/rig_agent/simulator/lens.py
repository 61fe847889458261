"""Which ray each pixel sees: a pinhole with a radial lens, inverted by table."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_protocol.camera import Intrinsics

Plane = npt.NDArray[np.float32]

_TABLE_LENGTH = 8192
_TABLE_REACH = 1.6  # tangent of the steepest ray; a Kinect's corner sees 0.8


@dataclass(frozen=True, slots=True, eq=False)
class RayGrid:
    """Rays (x, y, 1) of a grid of samples, two planes (rows, columns)."""

    x: Plane
    y: Plane
    x_range: tuple[Plane, Plane]
    """Least and greatest x of each column."""
    y_range: tuple[Plane, Plane]
    """Least and greatest y of each row."""

    @classmethod
    def of(cls, x: Plane, y: Plane) -> "RayGrid":
        """A grid with its ranges."""
        return cls(x, y, (x.min(axis=0), x.max(axis=0)), (y.min(axis=1), y.max(axis=1)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.x.shape[0], self.x.shape[1]

    @property
    def spacing(self) -> float:
        """Distance of neighbouring samples near the axis, as a tangent."""
        middle = self.shape[0] // 2
        return float(self.y[middle + 1, 0] - self.y[middle, 0])

    def window(
        self, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64]
    ) -> tuple[slice, slice] | None:
        """Rows and columns that may see rays between the corners low (x, y) and high (x, y), if any do."""
        rows = np.flatnonzero((self.y_range[1] >= low[1]) & (self.y_range[0] <= high[1]))
        columns = np.flatnonzero((self.x_range[1] >= low[0]) & (self.x_range[0] <= high[0]))
        if not rows.size or not columns.size:
            return None
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def crop(self, window: tuple[slice, slice]) -> tuple[Plane, Plane]:
        """x and y of the rays of a window."""
        return self.x[window], self.y[window]


def ray_grid(camera: Intrinsics, samples: int = 1) -> RayGrid:
    """Rays of samples × samples points spread evenly over each pixel; pixel centres are integers.

    Only radial distortion (k1, k2, k3): a simulated unit's lens is centred.
    """
    u = (np.arange(camera.width * samples) + 0.5) / samples - 0.5
    v = (np.arange(camera.height * samples) + 0.5) / samples - 0.5
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    k1, k2, _, _, k3 = camera.dist
    if any((k1, k2, k3)):
        radius = np.linspace(0, _TABLE_REACH, _TABLE_LENGTH)
        seen = radius * (1 + radius**2 * (k1 + radius**2 * (k2 + radius**2 * k3)))
        rising = (
            int(np.argmax(np.diff(seen) <= 0)) or _TABLE_LENGTH - 1
        )  # beyond its fold a model means nothing
        seen_radius = np.hypot(x, y)
        shrink = np.interp(seen_radius, seen[:rising], radius[:rising]) / np.maximum(seen_radius, 1e-12)
        x, y = x * shrink, y * shrink
    return RayGrid.of(x.astype(np.float32), y.astype(np.float32))
