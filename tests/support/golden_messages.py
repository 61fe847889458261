"""The messages whose bytes `wire_v1.json` pins, by name."""

from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    RejectReason,
    UnknownSession,
    Welcome,
)

ID = 0x1122334455667788

_MODEL = CameraModel(
    color=Intrinsics(525.0, 526.0, 319.5, 239.5, dist=(0.25, -0.5, 0.0, 0.0, 0.125)),
    depth=Intrinsics(580.0, 581.0, 320.0, 240.0),
    source="factory",
)
MESSAGES: dict[str, Message] = {
    "hello": Hello("cam07", 7, "A00362A01234047A", "1-1.2", _MODEL, (3, 2), (5,), 30.0, "rig-agent 0.1.0"),
    "hello without id, serial and depth": Hello(
        "cam", None, None, None, CameraModel(depth=None, T_color_depth=None), (2,), (), 15.0, "test"
    ),
    "welcome": Welcome(0x0123456789ABCDEF, 7, 3, None, 1472),
    "reject": Reject(RejectReason.DUPLICATE_SLOT, "slot 7 is held", 1, 1),
    "goodbye": Goodbye("the agent stops"),
    "heartbeat": Heartbeat({"temperature_c": 61.5}),
    "clock request": ClockRequest(1_000_000_000),
    "clock reply": ClockReply(1_000_000_000, -5, 2**62),
    "unknown session": UnknownSession(),
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
