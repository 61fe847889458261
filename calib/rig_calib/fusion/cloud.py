"""PointCloud: coloured points in the rig frame."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_protocol.frames import ImageU8

PointsM = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """`points_m` (N,3) f32 in the rig frame and their `colors` (N,3) u8, RGB.

    `skipped` says in a sentence each why a camera gave no points.
    """

    points_m: PointsM
    colors: ImageU8
    skipped: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """ValueError when the arrays do not belong together."""
        if self.points_m.shape != self.colors.shape or self.points_m.shape[1:] != (3,):
            raise ValueError(
                f"points {self.points_m.shape} and colors {self.colors.shape} must both be (N,3)"
            )

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points_m)
