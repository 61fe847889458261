"""Settings of `rig-server`: `rig.toml`, environment `RIG_SERVER_*` and the command line."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from rig_calib.settings import CalibrationSettings
from rig_protocol.camera import CameraModel
from rig_protocol.datagram import MIN_DATAGRAM_SIZE
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.events import Address
from rig_protocol.recorder import TakeSettings
from rig_protocol.rig_folder import RingDrawing, read_json
from rig_protocol.settings import Settings, load_settings
from rig_protocol.synchroniser import Policy

ENVIRONMENT_PREFIX = "RIG_SERVER_"
CONFIG_PLACES = (Path("rig.toml"), Path("/etc/kinect-rig/rig.toml"))
DEFAULT_PORT = 4012
MAX_SETS = 100  # of one calibration: more average nothing away, and fill the memory
MAX_CAMERAS = 64  # what one server holds in memory and one roster names; a ring has twelve
CAMERA_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$"  # it names folders and files


class RingSettings(Settings):
    """The drawing of the ring and how exactly it was built (standard deviation on each axis)."""

    radius_m: float = Field(0.22, ge=0, le=10)
    """Distance of the colour cameras from the ring's axis."""
    yaw_step_deg: float = Field(30.0, gt=0, le=180)
    """Angle from one camera to the next, counter-clockwise seen from above."""
    tolerance_deg: float = Field(1.0, gt=0, le=180)
    """By how much a camera is turned against the drawing."""
    tolerance_m: float = Field(0.005, gt=0, le=10)
    """By how much a camera is moved against the drawing."""

    def drawing(self) -> RingDrawing:
        """The same numbers as the calibration takes them."""
        return RingDrawing(self.radius_m, self.yaw_step_deg, self.tolerance_deg, self.tolerance_m)


class CameraSettings(Settings):
    """One camera of the rig. A hello that gives no slot finds its own by serial or port path."""

    id: int = Field(ge=0, lt=MAX_CAMERAS, examples=[0])
    """Slot in the ring; slot 0 defines the rig's x axis."""
    name: str | None = Field(None, pattern=CAMERA_NAME, examples=["cam00"])
    """Name in tables, reports and recordings; unset: cam00, cam01, ..."""
    serial: str | None = Field(None, examples=["A00366A10921051A"])
    """Serial number that the Kinect reports."""
    port_path: str | None = Field(None, examples=["1-1.2"])
    """USB port of its Pi that the Kinect's cable is in, for a unit without a serial number of its own."""
    intrinsics: Path | None = Field(None, examples=[Path("intrinsics/cam00.json")])
    """Intrinsics measured with `rig-calib intrinsics`; unset: what the agent sends."""

    @property
    def label(self) -> str:
        """The name, or the one that follows from the slot."""
        return self.name or f"cam{self.id:02d}"


class SynchroniserSettings(Settings):
    """How frames of free-running cameras are grouped into panoramic frames."""

    policy: Policy = "partial"
    """`partial`: a set waits for every camera of which a frame is due, up to its deadline. `strict`: only
    complete sets, at the rate of the slowest camera. `latest`: sets wait one frame period at most; a camera
    without a new frame repeats its last."""
    max_spread_ms: float | None = Field(None, gt=0, examples=[33.3])
    """Widest exposure spread of a set; unset: one frame period (`latest`: 1.5 of the slowest camera's)."""
    deadline_ms: float = Field(100.0, gt=0, le=10_000)
    """How long after one frame period a set waits for a frame that is late before it goes out partial, or is
    dropped if `strict`. Not used by `latest`."""


class LinkSettings(Settings):
    """The network between agents and server: what it carries, and what to do when that is too little.

    Agents on this machine load no port and are left out of the sum. `rig-server budget` prints it.
    """

    speed_mbit: float = Field(1000.0, gt=0, le=400_000)
    """Speed of the port that this PC hangs on, in Mbit/s."""
    agent_speed_mbit: float = Field(1000.0, gt=0, le=400_000)
    """Speed of each agent's own port, in Mbit/s; that of a Raspberry Pi 3 is 100."""
    mtu: int = Field(1500, ge=MIN_DATAGRAM_SIZE + 28, le=65_535)
    """Largest IP packet of the network in bytes; beyond 1500 every port and switch must be set up for it."""
    usable: float = Field(0.95, gt=0, le=1)
    """Share of a port to plan with; the rest is for resends, clock exchanges and scenes that change."""
    switch_buffer_kib: int = Field(128, ge=1, le=1 << 20)
    """What the switch buffers for one port; small ones have 128 to 256 KiB for all."""
    adapt: bool = True
    """Step down when the link is too small, and up again; false: refuse what does not fit."""
    jpeg: bool = True
    """Whether stepping down may send colour as JPEG; false: go to fewer frames at once."""
    size_margin: float = Field(1.25, ge=1, le=10)
    """How much larger than our real test frames to expect images before the first have come."""
    step_up_s: float = Field(10.0, ge=1, le=3600)
    """How long more must have fitted the link before it is sent."""


class CaptureSettings(Settings):
    """What `--calibrate` waits for and collects."""

    frames: int = Field(5, ge=1, le=MAX_SETS)
    """Panoramic frames to calibrate on."""
    target_deg: float | None = Field(None, gt=0, le=180, examples=[0.1])
    """End as soon as every pair of neighbours is expected to be known this well (root mean square)."""
    target_mm: float | None = Field(None, gt=0, le=10_000, examples=[3.0])
    """The same for their distance; with both, both must hold. What K frames do not reach is a failure."""
    projector_groups: int = Field(1, ge=1, le=3)
    """In how many turns the projectors shine, so that none shines into a neighbour's view; 1: all at once."""
    wait_s: float = Field(60.0, gt=0, le=86_400)
    """How long to wait for the expected cameras, and then for complete sets."""


class WatchSettings(Settings):
    """The drift watch: whether a camera has moved since the rig was calibrated (docs/drift.md)."""

    calibration: Path | None = Field(None, examples=[Path("calibration/calibration.json")])
    """The calibration to watch over; unset: nobody watches."""
    every: int = Field(4, ge=1, le=1000)
    """It looks at one panoramic frame in so many; a look at twelve cameras takes some 60 ms of one core."""


class RecordingSettings(TakeSettings):
    """How `--record FILE.mcap` records (docs/recording.md)."""

    folder: Path = Path()
    """Where takes go that are begun while the server runs; relative to where it was started."""


class ConsoleSettings(Settings):
    """The console: the rig in a web browser (docs/console.md)."""

    listen: str | None = Field(None, examples=["8080"])
    """Where browsers find it, [HOST:]PORT; a port alone is for this machine only. Unset: there is none."""
    token_file: Path | None = Field(None, examples=[Path("/etc/kinect-rig/console.token")])
    """The token that a browser must bring, in a file of mode 0600; unset: a new one at every start."""
    tile_hz: float = Field(10.0, gt=0, le=30)
    """How often a second the cameras' pictures are sent to pages that look."""
    fused_hz: float = Field(4.0, gt=0, le=30)
    """How often a second sets are fused for cloud and panorama, while a page looks: some 100 ms of a core."""
    cloud_points: int = Field(80_000, ge=100, le=2_000_000)
    """Points of the cloud that pages are sent, thinned evenly; a point takes 9 bytes."""
    match_colors: bool = False
    """Cloud and panorama make cameras of different exposure agree, by the first set: hold the exposures."""
    folder: Path = Path("calibration")
    """Where an accepted calibration is written, and where a live rig's console finds that of last time."""

    @field_validator("listen", mode="before")
    @classmethod
    def _listen_may_be_a_number(cls, value: object) -> object:
        return str(value) if isinstance(value, int) else value

    @field_validator("listen")
    @classmethod
    def _listen_is_an_address(cls, text: str | None) -> str | None:
        if text is not None:
            parse_service_address(text)
        return text

    @property
    def address(self) -> Address | None:
        """`listen` as (host, port); None when there is no console."""
        return None if self.listen is None else parse_service_address(self.listen)


class RigSettings(Settings):
    """Settings of rig-server. Write your own values over the defaults below."""

    listen: str = "0.0.0.0:4012"  # agents are on other machines: all interfaces are the purpose
    """Address and UDP port to receive on."""
    expected_cameras: int | None = Field(None, ge=1, le=MAX_CAMERAS, examples=[12])
    """How many cameras to wait for when none are listed below; unset: as many as come."""
    key_file: Path | None = Field(None, examples=[Path("/etc/kinect-rig/rig.key")])
    """The rig's key, as `rig-server keygen` made it; unset: ./rig.key, else /etc/kinect-rig/rig.key."""
    insecure: bool = False
    """Take frames of anybody who sends some: only for an isolated bench."""
    receive_buffer_bytes: int = Field(32 << 20, ge=65_536, le=1 << 30)
    """Kernel receive buffer to ask for; the kernel's limit is net.core.rmem_max."""
    decoder_threads: int = Field(2, ge=1, le=64)
    """Threads that decode frames; a pair takes about 0.6 ms of one core."""
    demosaic: bool = False
    """Whether the decoder threads make the colour image of every Bayer frame, too; else who needs it does."""
    metrics: str | None = Field(None, examples=["9100"])
    """Where Prometheus may ask for metrics, [HOST:]PORT; a port alone is for this machine only."""
    control_socket: Path | None = Field(None, examples=[Path("/run/kinect-rig/control.sock")])
    """Where `rig-server control` reaches the running server (docs/control.md); unset: this one where the
    server may write there, else kinect-rig/control.sock in $XDG_RUNTIME_DIR."""
    announce: bool = True
    """Whether agents with `server = "auto"` may find this server by mDNS; one on loopback says nothing."""
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = "INFO"
    """What is worth a line in the log."""
    synchroniser: SynchroniserSettings = SynchroniserSettings()
    link: LinkSettings = LinkSettings()
    capture: CaptureSettings = CaptureSettings()
    calibration: CalibrationSettings = CalibrationSettings()
    watch: WatchSettings = WatchSettings()
    recording: RecordingSettings = RecordingSettings()
    console: ConsoleSettings = ConsoleSettings()
    ring: RingSettings | None = None
    """The drawing of the ring; leave it out when the cameras' places are unknown."""
    cameras: tuple[CameraSettings, ...] = ()
    """The cameras that belong to the rig; when none are listed, any agent may join."""

    @field_validator("listen")
    @classmethod
    def _listen_is_an_address(cls, text: str) -> str:
        parse_address(text)
        return text

    @field_validator("metrics", mode="before")
    @classmethod
    def _metrics_may_be_a_number(cls, value: object) -> object:
        return str(value) if isinstance(value, int) else value

    @field_validator("metrics")
    @classmethod
    def _metrics_is_an_address(cls, text: str | None) -> str | None:
        if text is not None:
            parse_service_address(text)
        return text

    @model_validator(mode="after")
    def _cameras_are_distinct(self) -> Self:
        for key in ("id", "label", "serial"):
            values = [getattr(camera, key) for camera in self.cameras]
            twice = {value for value in values if value is not None and values.count(value) > 1}
            if twice:
                raise ValueError(f"two cameras share {'name' if key == 'label' else key} {min(twice)!r}")
        if self.cameras and self.expected_cameras not in (None, len(self.cameras)):
            raise ValueError(f"expected_cameras is {self.expected_cameras}, {len(self.cameras)} are listed")
        return self

    @property
    def address(self) -> Address:
        """`listen` as (host, port)."""
        return parse_address(self.listen)

    @property
    def metrics_address(self) -> Address | None:
        """`metrics` as (host, port); None when nobody may ask."""
        return None if self.metrics is None else parse_service_address(self.metrics)


def load_rig_settings(file: Path | None, overrides: Mapping[str, Any] | None = None) -> RigSettings:
    """Settings from `file`, else ./rig.toml, else /etc/kinect-rig/rig.toml, else the defaults."""
    found = file or settings_file()
    settings = load_settings(RigSettings, found, ENVIRONMENT_PREFIX, overrides)
    if found is None:
        return settings
    cameras = [_beside(found, camera) for camera in settings.cameras]
    watch = settings.watch
    # Where the command line names a calibration, it is relative to where that was typed.
    if watch.calibration is not None and not _overridden(overrides, "watch", "calibration"):
        watch = watch.model_copy(update={"calibration": found.parent / watch.calibration})
    return settings.model_copy(update={"cameras": tuple(cameras), "watch": watch})


def settings_file() -> Path | None:
    """The settings file that is read where none is named; None where there is none."""
    return next((place for place in CONFIG_PLACES if place.is_file()), None)


def parse_address(text: str) -> Address:
    """HOST:PORT, HOST, :PORT or [IPv6]:PORT; ValueError says what is wrong with it."""
    host, _, port_text = text.rpartition(":") if ":" in text else (text, "", str(DEFAULT_PORT))
    host = host.removeprefix("[").removesuffix("]")
    if not port_text.isdecimal() or not 0 <= int(port_text) <= 65_535:
        raise ValueError(f"{text!r} is not HOST:PORT with a port from 0 to 65535")
    return host or "0.0.0.0", int(port_text)  # noqa: S104  # an empty host means all interfaces, as in `:4012`


def parse_service_address(text: str) -> Address:
    """[HOST:]PORT; without a host only this machine may ask. ValueError says what is wrong with it."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or text.startswith(":"):
        raise ValueError(f"{text!r} is not PORT or HOST:PORT; for all interfaces write 0.0.0.0:PORT")
    return parse_address(f"{host or '127.0.0.1'}:{port}")


def read_intrinsics(path: Path) -> CameraModel:
    """A camera model file; ConfigurationError when it is absent or malformed."""
    try:
        return CameraModel.from_dict(read_json(path))
    except DataError as error:
        raise ConfigurationError(f"intrinsics file {path}: {error}") from error


def _overridden(overrides: Mapping[str, Any] | None, table: str, key: str) -> bool:
    return ((overrides or {}).get(table) or {}).get(key) is not None


def _beside(file: Path, camera: CameraSettings) -> CameraSettings:
    """Intrinsics paths in rig.toml are relative to it."""
    if camera.intrinsics is None:
        return camera
    return camera.model_copy(update={"intrinsics": file.parent / camera.intrinsics})
