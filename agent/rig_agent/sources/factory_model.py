"""A unit's own depth model from the zero-plane data in its firmware.

It holds the depth camera's focal length and the scale of its disparity. It is silent about the colour camera,
principal points, distortion and how the cameras stand to each other (libfreenect gives 2.4 cm between them,
whatever the unit says). So the model's `source` stays "default": calibration must leave all that as wide as
for a unit of which nothing is known.
"""

from rig_agent.sources.libfreenect import ZeroPlane
from rig_protocol.camera import CameraModel, Intrinsics, RawDepthModel

# Real units lie close to 575.8 px, 345.5 m and 1089; anything far from it is not calibration data.
_PLAUSIBLE_FOCAL_PX = (500.0, 660.0)
_PLAUSIBLE_NUMERATOR_M = (280.0, 420.0)
_PLAUSIBLE_OFFSET = (1040.0, 1140.0)
_SUBPIXEL_STEPS = 4  # raw disparity counts quarters of a zero-plane pixel ...
_STEP_OFFSET = 0.375  # ... from this rounding offset
_BINNING = 2  # the zero plane is of the 1280-pixel sensor, images have 640


def camera_model(zero_plane: ZeroPlane | None) -> CameraModel:
    """The factory's focal length and disparity model; documented defaults where they are not plausible.

    libfreenect computes z_mm = 10·(m·ref / (emit − m) + ref) with m = ((raw − 4·shift)/4 − 0.375)·pixel;
    solved for the poles, z_mm = 40·ref·emit/pixel / (4·(emit/pixel + shift + 0.375) − raw).
    """
    if zero_plane is None or zero_plane.reference_pixel_size_cm <= 0:
        return CameraModel()
    emit, ref = zero_plane.emitter_distance_cm, zero_plane.reference_distance_cm
    pixel = zero_plane.reference_pixel_size_cm
    focal_px = ref / (_BINNING * pixel)
    numerator_m = 10 * _SUBPIXEL_STEPS * ref * emit / pixel / 1000
    offset = _SUBPIXEL_STEPS * (emit / pixel + zero_plane.const_shift + _STEP_OFFSET)
    if not (
        _within(focal_px, _PLAUSIBLE_FOCAL_PX)
        and _within(numerator_m, _PLAUSIBLE_NUMERATOR_M)
        and _within(offset, _PLAUSIBLE_OFFSET)
    ):
        return CameraModel()
    return CameraModel(
        depth=Intrinsics(focal_px, focal_px, 319.5, 239.5), raw_model=RawDepthModel(numerator_m, offset)
    )


def _within(value: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] <= value <= bounds[1]  # False for NaN
