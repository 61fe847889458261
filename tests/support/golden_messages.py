"""What `wire_v2.json` pins: a handshake of given secrets, every message, and a frame under both ciphers."""

from collections.abc import Callable

from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.clear_datagram import encode_clear
from rig_protocol.datagram import DatagramBatch
from rig_protocol.fragmenter import fragment
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.gravity import Gravity
from rig_protocol.handshake import AgentHandshake, answer_hello
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import (
    WHOLE_FRAME,
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    RejectReason,
    Resend,
    StreamPlan,
    UnknownSession,
    Welcome,
)
from rig_protocol.rig_key import RigKey
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import Cipher, FrameSeal, SessionKeys

RIG_KEY = RigKey(bytes(range(0x20, 0x40)))
NONCE = 0x1122334455667788
AGENT_PRIVATE = bytes(range(0x40, 0x60))
SERVER_PRIVATE = bytes(range(0x60, 0x80))
SESSION_ID = 0x0123456789ABCDEF

_MODEL = CameraModel(
    color=Intrinsics(525.0, 526.0, 319.5, 239.5, dist=(0.25, -0.5, 0.0, 0.0, 0.125)),
    depth=Intrinsics(580.0, 581.0, 320.0, 240.0),
    source="factory",
)
HELLOS: dict[str, Hello] = {
    "full": Hello("cam07", 7, "A00362A01234047A", "1-1.2", _MODEL, (3, 2), (5,), 30.0, "rig-agent 0.1.0"),
    "without id, serial and depth": Hello(
        "cam", None, None, None, CameraModel(depth=None, T_color_depth=None), (2,), (), 15.0, "test",
        (Cipher.CHACHA20_POLY1305,),
    ),
}  # fmt: skip
WELCOME = Welcome(SESSION_ID, 7, (3, 2), (5,), 1472, Cipher.AES_256_GCM)

CLEAR: dict[str, tuple[Message, int]] = {
    "reject": (Reject(RejectReason.WRONG_KEY, "the agent holds another key"), NONCE),
    "unknown session": (UnknownSession(), SESSION_ID),
}
FROM_AGENT: dict[str, Message] = {
    "heartbeat": Heartbeat({"temperature_c": 61.5}, 1234),
    "clock reply": ClockReply(1_000_000_000, -5, 2**62),
    "clock reply of a disciplined clock": ClockReply(1, 2, 3, 1_700_000_000_000_000_000, 25_000),
    "goodbye": Goodbye("the agent stops"),
    "heartbeat with gravity": Heartbeat({}, 5, Gravity((0.6, -0.8, 0.0), 1.5)),
}
FROM_SERVER: dict[str, Message] = {
    "clock request": ClockRequest(1_000_000_000),
    "resend": Resend(9, ((0, 1), (17, 3))),
    "resend of a whole frame": Resend(10, WHOLE_FRAME),
    "plan": StreamPlan(3, None, 15.0, 1_000_000, 250_000, 0.8, -123_456_789),
    "goodbye": Goodbye("the server stops"),
}

FRAME = EncodedFrame(
    camera_id=7,
    sequence=0x0102030405060708,
    timestamp_ns=-2,
    uncertainty_ns=1000,
    color=Payload(3, bytes(range(200)) * 7),
    depth=Payload(5, bytes(range(100)) * 2),
    depth_frame="color",
    damaged=True,
)
FRAME_NUMBER = 9
DATAGRAM_SIZE = 1200


def given(nonce: int, private: bytes) -> Callable[[int], bytes]:
    """A source of these secrets instead of random ones."""
    return lambda size: nonce.to_bytes(8, "little") if size == 8 else private


def hello_of(name: str) -> AgentHandshake:
    """The agent's side of the pinned handshake."""
    return AgentHandshake(HELLOS[name], RIG_KEY, given(NONCE, AGENT_PRIVATE))


def welcome_and_keys() -> tuple[bytes, SessionKeys]:
    """The server's answer to the full hello."""
    hello = hello_of("full").datagram
    datagram, agreement = answer_hello(hello, NONCE, WELCOME, RIG_KEY, given(0, SERVER_PRIVATE))
    return datagram, agreement.keys


def clear_datagrams() -> dict[str, bytes]:
    """Datagrams outside of a session."""
    return {name: encode_clear(*encode_body(message), id_) for name, (message, id_) in CLEAR.items()}


def channels(cipher: Cipher) -> tuple[SealedChannel, SealedChannel]:
    """The agent's and the server's end of the session."""
    _, keys = welcome_and_keys()
    return (
        SealedChannel(cipher, keys.agent_control, keys.server_control, SESSION_ID),
        SealedChannel(cipher, keys.server_control, keys.agent_control, SESSION_ID),
    )


def sealed_datagrams(cipher: Cipher) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """What the agent and the server say, in this order, from counter 0 on."""
    agent, server = channels(cipher)
    return (
        {name: agent.seal(*encode_body(message)) for name, message in FROM_AGENT.items()},
        {name: server.seal(*encode_body(message)) for name, message in FROM_SERVER.items()},
    )


def frame_datagrams(cipher: Cipher) -> DatagramBatch:
    """The frame as number 9 of the session."""
    seal = FrameSeal(cipher, welcome_and_keys()[1])
    return fragment(FRAME, SESSION_ID, FRAME_NUMBER, seal, DATAGRAM_SIZE)
