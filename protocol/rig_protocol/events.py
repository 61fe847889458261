"""What a link tells its owner: the only things that come out of `next_event()`."""

from dataclasses import dataclass, field
from enum import StrEnum

from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import ControlValue, Hello, RejectReason, Welcome

Address = tuple[str, int]


# ---- agent side


@dataclass(frozen=True, slots=True)
class Connected:
    """The server accepted the hello."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class Rejected:
    """The server refused the hello; `text` is for the operator. The link retries by itself."""

    reason: RejectReason
    text: str


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The session ended (time-out, goodbye, server restart); the link says hello again by itself."""

    text: str


@dataclass(frozen=True, slots=True)
class ControlRequested:
    """The server wants `name` set to `value`: do it and tell `answer_control`. Each comes once."""

    session_id: int
    number: int
    name: str
    value: ControlValue


AgentEvent = Connected | Rejected | Disconnected | ControlRequested


# ---- server side


@dataclass(frozen=True, slots=True)
class CameraJoined:
    """A camera's hello was accepted."""

    camera_id: int
    hello: Hello
    address: Address


@dataclass(frozen=True, slots=True)
class CameraLeft:
    """A camera said goodbye, fell silent or was replaced by its own new session."""

    camera_id: int
    text: str


@dataclass(frozen=True, slots=True)
class HelloRefused:
    """A hello was answered with a reject; at most one event a second and address.

    `hello`: what it said, where it holds the rig's key and its content is in order.
    """

    address: Address
    reason: RejectReason
    text: str
    hello: Hello | None = field(default=None, compare=False)  # its camera model holds arrays


@dataclass(frozen=True, slots=True)
class FrameReceived:
    """A whole frame, stamped in rig time with its clock uncertainty."""

    frame: EncodedFrame


class Outcome(StrEnum):
    """What became of a control; of an unanswered one nobody knows whether it was done."""

    DONE = "done"
    REFUSED = "refused"
    UNANSWERED = "unanswered"


@dataclass(frozen=True, slots=True)
class ControlAnswered:
    """What became of the control with this ticket of `ServerLink.control`; comes once for each."""

    camera_id: int
    ticket: int
    outcome: Outcome
    text: str


ServerEvent = CameraJoined | CameraLeft | HelloRefused | FrameReceived | ControlAnswered
