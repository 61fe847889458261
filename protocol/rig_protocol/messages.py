"""Control messages: what agent and server say to each other beside frames."""

from dataclasses import dataclass
from enum import Enum

from rig_protocol.camera import CameraModel


class RejectReason(Enum):
    """Why a hello was refused; the value is the wire code."""

    VERSION_MISMATCH = 1
    UNKNOWN_CAMERA = 2
    DUPLICATE_SLOT = 3
    NO_COMMON_CODEC = 4
    MALFORMED = 5


@dataclass(frozen=True, slots=True, eq=False)
class Hello:
    """Who an agent is and what it can send.

    `camera_id` is the slot in the rig; None leaves it to the server, which knows the camera by its
    serial or port path. Codecs are wire ids in the agent's order of preference.
    """

    name: str
    camera_id: int | None
    serial: str | None
    port_path: str | None
    model: CameraModel
    color_codecs: tuple[int, ...]
    depth_codecs: tuple[int, ...]
    fps: float
    software: str


@dataclass(frozen=True, slots=True)
class Welcome:
    """The server's choices for one session."""

    session_id: int
    camera_id: int
    color_codec: int | None
    depth_codec: int | None
    datagram_size: int
