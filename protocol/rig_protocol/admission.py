"""Whether a hello is welcome, and what an agent is told that is not (protocol/SPEC.md, sections 5 and 6)."""

from collections.abc import Callable, Sequence

from rig_protocol.datagram import VERSION
from rig_protocol.errors import DataError
from rig_protocol.events import Address
from rig_protocol.messages import Hello, Reject, RejectReason
from rig_protocol.roster import describe, known_serial
from rig_protocol.server_session import CameraStatus, ServerSession

# A holder that missed a heartbeat and two clock replies in a row gives way to another agent.
HOLDER_LIVE_NS = 750_000_000

Objection = Callable[[int, Hello, Address, int], str | None]
"""Why a camera (id, hello, address) has no room at a rig time; None where it has."""

Codecs = tuple[tuple[int, ...], tuple[int, ...]]


def same_agent(status: CameraStatus, hello: Hello, address: Address) -> bool:
    """True when a hello comes from the agent that we know as `status`, perhaps restarted."""
    serial = known_serial(hello)
    return status.address == address or (serial is not None and serial == known_serial(status.hello))


def gives_way(holder: ServerSession, hello: Hello, address: Address, now_ns: int) -> bool:
    """True when a hello may end the session that holds its slot."""
    return same_agent(holder.status, hello, address) or now_ns - holder.last_heard_ns >= HOLDER_LIVE_NS


def choose_codecs(hello: Hello, color_codecs: Sequence[int], depth_codecs: Sequence[int]) -> Codecs | Reject:
    """For each stream the codecs that the server takes, in the agent's order; none for no such stream."""
    chosen = []
    for stream, offered, accepted in (
        ("colour", hello.color_codecs, color_codecs),
        ("depth", hello.depth_codecs, depth_codecs),
    ):
        common = [codec_id for codec_id in offered if codec_id in accepted]
        if offered and not common:
            return Reject(
                RejectReason.NO_COMMON_CODEC,
                f"{describe(hello)} offers {stream} codecs {_listed(offered)}, "
                f"this server takes {_listed(accepted)}: install the same release on both",
            )
        chosen.append(tuple(common))
    return chosen[0], chosen[1]


def duplicate_slot(holder: ServerSession, hello: Hello, now_ns: int) -> Reject:
    """The answer to a second camera in one slot."""
    host, port = holder.address
    silence_ms = (now_ns - holder.last_heard_ns) / 1e6
    return Reject(
        RejectReason.DUPLICATE_SLOT,
        f"slot {holder.welcome.camera_id} is held by {describe(holder.status.hello)} at {host}:{port}, heard "
        f"{silence_ms:.0f} ms ago; {describe(hello)} needs another camera id, or the other agent must stop",
    )


def version_mismatch(theirs: int) -> Reject:
    """The answer to a hello of another version."""
    return Reject(
        RejectReason.VERSION_MISMATCH,
        f"the agent speaks protocol version {theirs}, this server speaks {VERSION}: "
        "install the same release on both",
    )


def wrong_key(server_is_insecure: bool) -> Reject:
    """The answer to an agent that does not hold this rig's key."""
    advice = (
        "this server runs with --insecure, the agent does not"
        if server_is_insecure
        else "copy the server's key file to the agent's machine, and start neither with --insecure"
    )
    return Reject(RejectReason.WRONG_KEY, f"the agent holds another key than this rig: {advice}")


def no_room(why: str) -> Reject:
    """The answer to a camera whose frames do not fit the link."""
    return Reject(RejectReason.NO_ROOM, why)


def malformed_hello(error: DataError) -> Reject:
    """The answer to a hello that breaks the protocol."""
    return Reject(RejectReason.MALFORMED, f"the hello is malformed: {error}")


def _listed(codec_ids: Sequence[int]) -> str:
    return ", ".join(map(str, codec_ids)) or "none"
