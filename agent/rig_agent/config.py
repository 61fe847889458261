"""Settings of `rig-agent`: `agent.toml`, environment `RIG_AGENT_*` and the command line."""

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.sources.freenect import FreenectSettings
from rig_agent.sources.openni2 import Openni2Settings
from rig_protocol.datagram import DEFAULT_DATAGRAM_SIZE, MAX_DATAGRAM_SIZE, MIN_DATAGRAM_SIZE
from rig_protocol.events import Address
from rig_protocol.recorder import TakeSettings
from rig_protocol.settings import Settings, load_settings

ENVIRONMENT_PREFIX = "RIG_AGENT_"
CONFIG_PLACES = (Path("agent.toml"), Path("/etc/kinect-rig/agent.toml"))
DEFAULT_PORT = 4012
AUTO, NOBODY = "auto", "none"

SourceName = Literal["freenect", "openni2", "folder", "recording", "synthetic"]
Manner = Literal["lossless", "jpeg", "raw"]
"""How images travel: losslessly compressed, as JPEG, uncompressed."""


class FolderSettings(Settings):
    """A recorded rig folder, one camera of it."""

    path: Path | None = Field(None, examples=[Path("recordings/office")])
    """Folder that holds nominal.json and one subfolder a camera."""
    camera: int | str | None = Field(None, examples=["cam00"])
    """Camera of the folder, by id or name; unset: the agent's own slot `camera`."""


class RecordingSettings(Settings):
    """A recorded take, one camera of it (docs/recording.md)."""

    path: Path | None = Field(None, examples=[Path("takes/office.mcap")])
    """The take's first file."""
    camera: int | str | None = Field(None, examples=["cam00"])
    """Camera of the take, by id or name; unset: the agent's own slot `camera`."""


class RecordSettings(TakeSettings):
    """Recording on this machine's own disk, every frame as the source gives it (docs/recording.md)."""

    path: Path | None = Field(None, examples=[Path("/var/lib/kinect-rig/takes")])
    """The file to record to, or a folder, where every start begins a new file; unset: none is recorded."""
    stream: bool = True
    """Whether frames go to the server, too; false: it hears from this camera, but gets no frames."""
    queue_mib: int = Field(64, ge=8, le=1 << 20)
    """Memory for frames that wait for a slow disk; what does not fit is dropped, and told in the file."""


class PacingSettings(Settings):
    """How a frame's datagrams are spread in time, so that twelve agents do not overflow one switch port."""

    spread: float = Field(0.8, ge=0, le=1)
    """Share of the frame interval to send a frame over; 0 sends it at once."""
    burst: int = Field(8, ge=1, le=44)
    """Datagrams sent together."""


class AgentSettings(Settings):
    """Settings of rig-agent. Remove the # before a key to change it; shown are the defaults."""

    server: str = Field(AUTO, examples=["rig-server.local:4012"])
    """Where rig-server listens: HOST:PORT or HOST; `auto`: where one announces itself by mDNS;
    `none`: only record."""
    source: SourceName = "freenect"
    """Where frames come from: a Kinect, any OpenNI2 device or recording, a rig folder or the simulator."""
    camera: int | None = Field(None, ge=0, lt=64, examples=[0])
    """Slot of this camera in the ring; unset: the server knows it by serial number or USB port."""
    name: str | None = Field(None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$", examples=["cam00"])
    """Name that the operator sees; unset: cam00, cam01, ... after the slot, else this machine's name."""
    fps: float | None = Field(None, ge=0.1, le=120, examples=[30.0])
    """Frames a second to send; unset: as many as the source delivers (a folder: 30)."""
    color: Manner = "lossless"
    """How colour travels while the link has room: losslessly compressed, as JPEG, or uncompressed."""
    depth: Literal["lossless", "raw"] = "lossless"
    """How depth travels: losslessly compressed or uncompressed."""
    datagram_size: int = Field(DEFAULT_DATAGRAM_SIZE, ge=MIN_DATAGRAM_SIZE, le=MAX_DATAGRAM_SIZE)
    """Largest UDP payload in bytes: the path's MTU minus 28 (jumbo frames: 8972)."""
    report_interval_s: float = Field(60.0, ge=1, le=3600)
    """How often one line in the log tells rates, drops and reconnects."""
    key_file: Path | None = Field(None, examples=[Path("/etc/kinect-rig/rig.key")])
    """The rig's key, as `rig-server keygen` made it; unset: ./rig.key, else /etc/kinect-rig/rig.key."""
    insecure: bool = False
    """Neither authenticate nor keep secret: only for an isolated bench."""
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = "INFO"
    """What is worth a line in the log."""
    record: RecordSettings = RecordSettings()
    """Recording on this machine's own disk."""
    pacing: PacingSettings = PacingSettings()
    """How frames are spread in time."""
    freenect: FreenectSettings = FreenectSettings()
    """Options of `source = "freenect"`: which Kinect."""
    openni2: Openni2Settings = Openni2Settings()
    """Options of `source = "openni2"`: which device or recording."""
    folder: FolderSettings = FolderSettings()
    """Options of `source = "folder"`."""
    recording: RecordingSettings = RecordingSettings()
    """Options of `source = "recording"`."""
    synthetic: SimulatorSettings = SimulatorSettings()
    """Options of `source = "synthetic"`: the simulated rig; `camera` is the one that this agent plays."""

    @field_validator("server")
    @classmethod
    def _server_is_an_address(cls, text: str) -> str:
        if text not in (AUTO, NOBODY):
            _parse_address(text)
        return text

    @model_validator(mode="after")
    def _has_something_to_do(self) -> Self:
        if self.server == NOBODY and self.record.path is None:
            raise ValueError("without a server there must be a file or folder to record to: give --record")
        return self

    @property
    def streams(self) -> bool:
        """Whether frames go to the server."""
        return self.record.path is None or self.record.stream

    @property
    def address(self) -> Address | None:
        """`server` as (host, port); None where one is to be found, or nobody listens."""
        return None if self.server in (AUTO, NOBODY) else _parse_address(self.server)

    def display_name(self, slot: int | None) -> str:
        """The name, or the one that follows from the slot, or from the machine."""
        if self.name is not None:
            return self.name
        return platform.node()[:64] or "agent" if slot is None else f"cam{slot:02d}"


def load_agent_settings(file: Path | None, overrides: Mapping[str, Any] | None = None) -> AgentSettings:
    """Settings from `file`, else ./agent.toml, else /etc/kinect-rig/agent.toml, else the defaults.

    ConfigurationError names the wrong key and the nearest known one.
    """
    found = file or next((place for place in CONFIG_PLACES if place.is_file()), None)
    return load_settings(AgentSettings, found, ENVIRONMENT_PREFIX, overrides)


def _parse_address(text: str) -> Address:
    """HOST:PORT, HOST or [IPv6]:PORT; ValueError says what is wrong with it."""
    host, colon, port = text.rpartition(":")
    if not colon or text.endswith("]"):
        host, port = text, str(DEFAULT_PORT)
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or not 0 < int(port) <= 65_535:
        raise ValueError(f"{text!r} is not HOST or HOST:PORT with a port from 1 to 65535")
    return host, int(port)
