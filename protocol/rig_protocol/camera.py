"""What is known of one Kinect before calibration: both cameras, their transform, disparity to metres.

Data only. Projection lives with its users, so that the simulator and the estimator that it judges
share no formula.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from rig_protocol.errors import DataError
from rig_protocol.poses import Pose, is_pose

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
ModelSource = Literal["factory", "file", "default"]


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole camera with OpenCV's five distortion coefficients (k1, k2, p1, p2, k3); pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 640
    height: int = 480
    dist: tuple[float, float, float, float, float] = NO_DISTORTION

    def to_dict(self) -> dict[str, Any]:
        """The `formats.md` form: {fx, fy, cx, cy, width, height, dist}."""
        return {
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "width": self.width,
            "height": self.height,
            "dist": list(self.dist),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Intrinsics":
        """Read the `formats.md` form; DataError when a number is absent, not finite or out of reason."""
        try:
            fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
            width, height = int(values.get("width", 640)), int(values.get("height", 480))
            dist = [float(k) for k in values.get("dist") or NO_DISTORTION]
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(f"intrinsics need fx, fy, cx, cy, width, height, dist: {error!r}") from error
        if len(dist) != 5 or not np.isfinite([fx, fy, cx, cy, *dist]).all():
            raise DataError("intrinsics need finite numbers and five distortion coefficients")
        if not (fx > 0 and fy > 0 and 0 < width <= 4096 and 0 < height <= 4096):
            raise DataError(f"intrinsics out of reason: fx {fx}, fy {fy}, {width}×{height}")
        return cls(fx, fy, cx, cy, width, height, (dist[0], dist[1], dist[2], dist[3], dist[4]))


@dataclass(frozen=True, slots=True)
class RawDepthModel:
    """Raw disparity d to metres: z = numerator_m / (offset − d).

    The default is libfreenect's factory conversion in closed form (f = 575.8 px, b = 75 mm, 1/8-px steps).
    """

    numerator_m: float = 345.4894
    offset: float = 1089.41

    def to_dict(self) -> dict[str, float]:
        """The `formats.md` form: {numerator_m, offset}."""
        return {"numerator_m": self.numerator_m, "offset": self.offset}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RawDepthModel":
        """Read the `formats.md` form; DataError when it makes no sense."""
        try:
            model = cls(float(values["numerator_m"]), float(values["offset"]))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(f"raw_model needs numerator_m and offset: {error!r}") from error
        if not (np.isfinite([model.numerator_m, model.offset]).all() and model.numerator_m > 0):
            raise DataError(f"raw_model out of reason: {model}")
        return model


# A typical unit where nothing was measured. Focal lengths and offsets: kinect_calibration figures of
# Burrus and of the ROS drivers' defaults; calibration treats them as uncertain.
DEFAULT_COLOR = Intrinsics(525.0, 525.0, 319.5, 239.5)
DEFAULT_DEPTH = Intrinsics(580.0, 580.0, 319.5, 239.5)


def _default_T_color_depth() -> Pose:
    """The depth camera sits 25 mm from the colour camera along the sensor's bar."""
    T = np.eye(4)
    T[0, 3] = -0.025
    return T


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """Intrinsics of both cameras of one unit, T_color_depth and the disparity model.

    `depth` and `T_color_depth` are None for a unit that only delivers depth registered to colour.
    """

    color: Intrinsics = DEFAULT_COLOR
    depth: Intrinsics | None = DEFAULT_DEPTH
    T_color_depth: Pose | None = field(default_factory=_default_T_color_depth)
    raw_model: RawDepthModel = field(default_factory=RawDepthModel)
    source: ModelSource = "default"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON files and the hello message."""
        return {
            "color": self.color.to_dict(),
            "depth": None if self.depth is None else self.depth.to_dict(),
            "T_color_depth": None if self.T_color_depth is None else self.T_color_depth.tolist(),
            "raw_model": self.raw_model.to_dict(),
            "source": self.source,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], raw_model: RawDepthModel | None = None) -> "CameraModel":
        """Read what `to_dict` writes, or one camera of a `nominal.json`; DataError when malformed.

        `raw_model` is what holds when the camera states none of its own.
        """
        if not isinstance(values, Mapping) or not isinstance(values.get("color"), Mapping):
            raise DataError("a camera model needs `color` intrinsics")
        depth, T = values.get("depth"), values.get("T_color_depth")
        if T is not None:
            T = as_pose(T, "T_color_depth")
        source = values.get("source", "file")
        if source not in ("factory", "file", "default"):
            raise DataError(f"camera model source {source!r} is none of factory, file, default")
        own = values.get("raw_model")
        return cls(
            color=Intrinsics.from_dict(values["color"]),
            depth=None if depth is None else Intrinsics.from_dict(depth),
            T_color_depth=T,
            raw_model=RawDepthModel.from_dict(own) if own is not None else raw_model or RawDepthModel(),
            source=source,
        )


def as_pose(values: Any, name: str) -> Pose:
    """A 4×4 rigid transform from nested lists; DataError names what is wrong."""
    try:
        T = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{name} must be a 4×4 matrix: {error}") from error
    if not is_pose(T):
        raise DataError(f"{name} must be a 4×4 rigid transform (rotation, translation, 0 0 0 1)")
    return T
