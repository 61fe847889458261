"""Control messages: what agent and server say to each other beside frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from rig_protocol.camera import CameraModel
from rig_protocol.datagram import VERSION
from rig_protocol.frames import EncodedFrame
from rig_protocol.gravity import Gravity
from rig_protocol.security import Cipher

ControlValue = bool | float | str


class RejectReason(Enum):
    """Why a hello was refused; the value is the wire code."""

    VERSION_MISMATCH = 1
    UNKNOWN_CAMERA = 2
    DUPLICATE_SLOT = 3
    NO_COMMON_CODEC = 4
    MALFORMED = 5
    WRONG_KEY = 6
    NO_ROOM = 7
    OTHER = 255  # a reason of a later version; the text says it


@dataclass(frozen=True, slots=True, eq=False)
class Hello:
    """Who an agent is and what it can send.

    `camera_id` is the slot in the rig; None leaves it to the server, which knows the camera by its
    serial or port path. Codecs are wire ids in the agent's order of preference; ciphers in the order of
    their speed on the agent's processor. `controls`: it does what a Control says.
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
    ciphers: tuple[Cipher, ...] = tuple(Cipher)
    controls: bool = False


@dataclass(frozen=True, slots=True)
class Welcome:
    """The server's choices for one session.

    Of the codecs, those of the hello that it takes, in the agent's order; none means: do not send this
    stream. The first is the one to send until a plan says otherwise. `controls`: there may be Controls.
    """

    session_id: int
    camera_id: int
    color_codecs: tuple[int, ...]
    depth_codecs: tuple[int, ...]
    datagram_size: int
    cipher: Cipher
    controls: bool = False

    def allows(self, frame: EncodedFrame) -> bool:
        """True when every payload of the frame is in a codec that the server takes for its stream."""
        streams = ((frame.color, self.color_codecs), (frame.depth, self.depth_codecs))
        return all(payload is None or payload.codec_id in taken for payload, taken in streams)


@dataclass(frozen=True, slots=True)
class Reject:
    """Why a hello was refused, and the versions [lowest, highest] that the server speaks."""

    reason: RejectReason
    text: str
    lowest_version: int = VERSION
    highest_version: int = VERSION


@dataclass(frozen=True, slots=True)
class StreamChoice:
    """What the server wants of one agent: a plan that does not know the agent's clock yet.

    Of each `step_ns` of rig time the agents take turns: this one is `slot` of `slots`. A frame is sent over
    the share `spread` of its interval.
    """

    color_codec: int | None
    depth_codec: int | None
    fps: float
    slot: int
    slots: int
    step_ns: int
    spread: float

    @property
    def phase_ns(self) -> int:
        """When its bursts begin, in rig time modulo `step_ns`."""
        return self.slot * self.step_ns // self.slots


@dataclass(frozen=True, slots=True)
class StreamPlan:
    """What an agent is to send from now on, and when: the server's share of the link for one camera.

    At most `fps` frames a second, one in each of the rig clock's intervals, and each sent over the share
    `spread` of its interval. Bursts of datagrams leave at rig times that are `phase_ns` modulo `step_ns`,
    so that those of different agents meet the switch one after another. Rig time is agent time and
    `offset_ns`, with the standard uncertainty `offset_uncertainty_ns`; `rig_clock` names the clock that it is
    (`rig:...`), the same for all servers that run on a machine until it is booted anew. None: not told.
    """

    color_codec: int | None
    depth_codec: int | None
    fps: float
    step_ns: int
    phase_ns: int
    spread: float
    offset_ns: int
    offset_uncertainty_ns: int | None = None
    rig_clock: str | None = None


@dataclass(frozen=True, slots=True)
class Goodbye:
    """The sender ends the session; `text` says why."""

    text: str


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The agent is alive; `health` are its own gauges by name, for the operator.

    `frames`: how many frames of this session have been sent, so that the last ones are missed, too.
    `gravity`: down as the camera feels it now, None where it has no accelerometer or is being moved.
    """

    health: Mapping[str, float]
    frames: int = 0
    gravity: Gravity | None = None


@dataclass(frozen=True, slots=True)
class ClockRequest:
    """`t1_ns`: rig time at sending."""

    t1_ns: int


@dataclass(frozen=True, slots=True)
class ClockReply:
    """`t1_ns` echoed; `t2_ns` and `t3_ns`: agent time at receiving the request and sending this.

    `wall_minus_agent_ns` and `wall_error_ns`: the agent's system clock against agent time, and its
    standard error where something disciplines it (chrony, PTP); None where nothing does.
    """

    t1_ns: int
    t2_ns: int
    t3_ns: int
    wall_minus_agent_ns: int = 0
    wall_error_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Resend:
    """Fragments of a frame that did not arrive: (first index, count), ascending.

    WHOLE_FRAME asks for all of a frame of which nothing arrived.
    """

    frame_number: int
    ranges: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Control:
    """The agent is to set `name` to `value`; `number` counts the controls of the session from 1."""

    number: int
    name: str
    value: ControlValue


@dataclass(frozen=True, slots=True)
class ControlResult:
    """What became of control `number`: done or refused, and in words for the operator."""

    number: int
    done: bool
    text: str


@dataclass(frozen=True, slots=True)
class UnknownSession:
    """The server does not know the session that the prefix names."""


Message = (
    Hello
    | Welcome
    | Reject
    | Goodbye
    | Heartbeat
    | ClockRequest
    | ClockReply
    | UnknownSession
    | Resend
    | StreamPlan
    | Control
    | ControlResult
)

WHOLE_FRAME = ((0, 0xFFFF),)
