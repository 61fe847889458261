"""What a reader of a panorama needs to make points of its pixels."""

from typing import Any

from rig_calib.frame_exports.content_hash import content_hash
from rig_calib.fusion.live import LiveFusion
from rig_calib.rig_calibration import RigCalibration


def panorama_geometry(fusion: LiveFusion, calibration: RigCalibration) -> dict[str, Any]:
    """The cylinder and its place, for JSON.

    Pixel (u, v), centres at integers, looks along the azimuth `azimuth_left_rad` − u · `radians_per_pixel`
    about z, 0 along x, and along the slope `slope_top` − v · `radians_per_pixel` of z over the distance from
    the axis, in the view frame, which `T_rig_view` places in the rig. Depth is that distance.
    """
    cylinder = fusion.cylinder
    return {
        "projection": "cylinder",
        "width": cylinder.width,
        "height": cylinder.height,
        "radians_per_pixel": 1.0 / cylinder.pixels_per_rad,
        "azimuth_left_rad": cylinder.azimuth_left_rad,
        "slope_top": cylinder.slope_top,
        "T_rig_view": fusion.T_rig_view.tolist(),
        "rig_frame": calibration.rig_frame,
        "calibration": content_hash(calibration.to_dict()),
    }
