"""What a user may set of a calibration; the effective values are saved with every result."""

from typing import Annotated, Literal

from pydantic import Field

from rig_protocol.settings import Settings

Positive = Annotated[float, Field(gt=0)]


class CalibrationSettings(Settings):
    """Settings of one calibration; the defaults are meant for every rig."""

    method: Literal["joint", "paper"] = "joint"
    """`joint`: one adjustment of poses, points and depth bias. `paper`: pairs, then a pose graph."""
    seed: int = 0
    """Of every random choice, so that the same input gives the same result."""
    max_keypoints: Annotated[int, Field(ge=50, le=20000)] = 3000
    """Strongest SIFT keypoints kept of one image; a third of that where patches refine them (`joint`)."""
    match_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.85
    """`joint`: nearest over second-nearest descriptor distance of a match."""
    match_max_distance: Positive = 250.0
    """`joint`: largest descriptor distance of a match; what looks less alike is also placed less well."""
    match_distance_multiple: Annotated[float, Field(gt=1)] = 7.0
    """`paper`: largest descriptor distance as a multiple of the smallest (table I of the paper)."""
    pixel_sigma: Positive = 0.25
    """Standard deviation of a small keypoint's position, pixels; large ones are placed less well."""
    bias_terms: Annotated[int, Field(ge=0, le=10)] = 6
    """Depth-bias states of a camera: terms of `DepthCorrection`."""
    bias_scale_sigma: Positive = 0.015
    """Prior standard deviation of the depth scale."""
    bias_shape_sigma: Positive = 0.023
    """Prior standard deviation of the depth bias's other terms, each peak to peak over the image.

    A real unit showed 34 mm peak to peak at 1.5 m.
    """
    min_inliers: Annotated[int, Field(ge=6)] = 8
    """Fewer matches that agree make no edge."""
    max_edge_sigma_deg: Positive = 1.5
    """An edge whose weakest direction is known less well than this is weak and not used."""
    max_edge_sigma_m: Positive = 0.06
    """As `max_edge_sigma_deg`, for translation."""
    max_pair_sigma_deg: Positive = 0.3
    """A pair that should share a view and is known less well than this fails the gate."""
    max_pair_sigma_m: Positive = 0.015
    """As `max_pair_sigma_deg`, for translation."""
