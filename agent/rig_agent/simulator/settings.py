"""What a simulated rig is made of: the reference scene by default, and knobs for robustness studies."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from rig_protocol.settings import Settings

FULL_CIRCLE_DEG = 360.0
OVERLAPPING_STEP_DEG = 30.0
"""Neighbours further apart than this share too little of a vertical Kinect's 43 degrees."""


RoomSide = Annotated[float, Field(ge=2.8, le=20)]
RoomHeight = Annotated[float, Field(ge=2.2, le=6)]


class Knock(Settings):
    """One camera knocked out of its place, from a frame on."""

    camera: int = Field(ge=0)
    """Id of the camera that is knocked."""
    deg: float = 4.0
    """Rotation, about a seeded axis."""
    m: float = 0.03
    """Translation, in a seeded direction."""
    from_frame: int = Field(0, ge=0)
    """First frame that is seen from the new place."""


class SimulatorSettings(Settings):
    """The reference scene; the same settings give the same rig, room and noise."""

    cameras: int = Field(12, ge=1, le=64)
    """Number of cameras; fewer than twelve make an open arc with the same 30-degree step."""
    seed: int = Field(0, ge=0)
    """Every seed is another room, other patterns, other units and other noise."""
    fps: float = Field(30.0, gt=0, le=120)
    """Frame rate of every camera; their phases are independent."""
    frames_rendered: int = Field(0, ge=0, le=64)
    """0: every frame has its own noise. K: K frames are made and looped, for load tests."""

    room_m: tuple[RoomSide, RoomSide, RoomHeight] = (4.0, 5.0, 2.6)
    """Length, width and height of the room."""
    ring_radius_m: float = Field(0.22, gt=0, lt=1)
    """Distance of the colour cameras from the rig's axis."""
    patterns: bool = True
    """Whether descriptor patterns hang on the walls."""
    pattern_coverage: float = Field(0.55, ge=0, le=0.6)
    """Share of the wall area given to patterns, before furniture hides some of it."""
    blocked_overlaps: int = Field(2, ge=0)
    """Overlaps of neighbours with a tall piece of furniture in front."""
    screened_overlap: int | None = Field(None, ge=0)
    """Index of an overlap with a plain screen so near that its two cameras see nothing in common."""

    people: int = Field(0, ge=0, le=8)
    """How many people walk around the rig, all the time."""

    mounting_deg: float = Field(1.0, ge=0)
    """Mounting error, one sigma an axis."""
    mounting_m: float = Field(0.005, ge=0)
    """Mounting error, one sigma an axis."""
    factory_error: float = Field(1.0, ge=0)
    """How wrong factory intrinsics are, in units of 0.1 % focal, 0.6 px, 0.04 degrees, 0.5 mm."""
    lens_k1: float = Field(0.0, ge=0, le=0.3)
    """Spread of the colour lenses' k1 that the camera model tells (a lens that was measured)."""
    lens_residual_k1: float = Field(0.001, ge=0, le=0.1)
    """Spread of k1 that nobody was told."""

    depth_bias: float = Field(0.01, ge=0, le=0.05)
    """Spread between units of the scale of depth, one sigma."""
    depth_distortion_mm: float = Field(34.0, ge=0)
    """Peak to peak of a unit's smooth depth distortion at 1.5 m."""
    disparity_noise_lsb: float = Field(0.55, ge=0.3)
    """Total disparity noise, rounding included."""
    frozen_noise: float = Field(0.5, ge=0, le=1)
    """Share of the disparity noise's variance that stays the same over frames."""
    interference: float = Field(0.02, ge=0, le=0.5)
    """Share of pixels that the neighbours' projectors spoil where they overlap."""
    interference_noise_lsb: float = Field(0.0, ge=0, le=20)
    """Error that neighbours' dots add where their projectors reach, one sigma: like the dots, it stays."""
    projector_folder: Path | None = None
    """Folder in which simulated Kinects of this machine tell each other that their projectors are off; unset:
    all shine, all the time."""
    exposure_spread: float = Field(0.12, ge=0, le=1)
    """Spread of the cameras' exposures, natural logarithm."""

    accelerometers: bool = True
    """Whether the units feel which way is down, as a Kinect does."""
    accelerometer_deg: float = Field(1.5, ge=0, le=15)
    """By how much a unit errs about that, one sigma an axis, the same all the time."""

    depthless_camera: int | None = None
    """Id of a camera that delivers colour only."""
    knock: Knock | None = None
    """A camera that is not where the drawing says."""

    @model_validator(mode="after")
    def _chosen_cameras_exist(self) -> Self:
        knocked = None if self.knock is None else self.knock.camera
        chosen = {"depthless_camera": self.depthless_camera, "knock.camera": knocked}
        for key, camera in chosen.items():
            if camera is not None and not 0 <= camera < self.cameras:
                raise ValueError(f"{key} {camera} is not in a ring of {self.cameras} cameras")
        if self.screened_overlap is not None and self.screened_overlap >= len(self.overlaps):
            raise ValueError(f"screened_overlap {self.screened_overlap} is not among {len(self.overlaps)}")
        return self

    @property
    def yaw_step_deg(self) -> float:
        """Angle between neighbours."""
        return min(OVERLAPPING_STEP_DEG, FULL_CIRCLE_DEG / self.cameras)

    @property
    def overlaps(self) -> tuple[tuple[int, int], ...]:
        """Pairs of neighbours with a common view; a full circle closes."""
        chain = [(i, i + 1) for i in range(self.cameras - 1)]
        closed = self.cameras > 2 and self.cameras * self.yaw_step_deg > FULL_CIRCLE_DEG - 1e-6
        return (*chain, (self.cameras - 1, 0)) if closed else tuple(chain)
