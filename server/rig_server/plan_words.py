"""What the operator reads of the link's plan."""

from rig_protocol.codecs import codec
from rig_protocol.codecs.raw import UncompressedCodec
from rig_server.link_budget import Port
from rig_server.link_demand import Demand, LinkDemand


def needs(demand: Demand) -> str:
    """How many cameras need how much: "12 cameras at 30 fps need 131.0 MB/s"."""
    who, verb = (f"{demand.cameras} cameras", "need") if demand.cameras != 1 else ("1 camera", "needs")
    return f"{who} at {demand.fps:.3g} fps {verb} {_mb(demand.udp_bytes_s)} MB/s"


def carries(rig: LinkDemand) -> str:
    """What the server's port carries, and how much of it is planned with."""
    usable = rig.settings.usable
    limit = "" if usable == 1 else f", of which {usable:.0%} may be used"
    return f"the link carries {_mb(rig.port.udp_bytes_s)}{limit}"


def too_much(demand: Demand, rig: LinkDemand) -> str:
    """Which port is too small for a demand."""
    own = demand.agent_wire_bytes_s / rig.agent_port.wire_bytes_s
    if own > demand.wire_bytes_s / rig.port.wire_bytes_s:
        speed = rig.settings.agent_speed_mbit
        return f"a camera at {demand.fps:.3g} fps takes {own:.0%} of its own port of {speed:g} Mbit/s"
    return f"{needs(demand)}, {carries(rig)}"


def what_goes(demand: Demand) -> str:
    """How images travel on a level."""
    color = [codec(one.color_codec) for one in demand.streams.values() if one.color_codec is not None]
    images = [codec(codec_id) for one in demand.streams.values() for codec_id in one.codecs]
    if not all(one.lossless for one in color):
        how = "colour goes as JPEG"
    elif any(isinstance(one, UncompressedCodec) for one in images):
        how = "images go uncompressed"
    else:
        how = "everything goes losslessly compressed"
    return f"{how} at {demand.fps:.3g} fps"


def summary(demand: Demand, port: Port) -> str:
    """The present level."""
    if not demand.cameras:
        return "all cameras are on this machine: no port to share"
    share = demand.wire_bytes_s / port.wire_bytes_s
    return f"{needs(demand)}, {share:.0%} of the link: {what_goes(demand)}"


def step_down(reason: str, after: Demand) -> str:
    """What is done about it."""
    return f"{reason}: {what_goes(after)} ({_mb(after.udp_bytes_s)} MB/s)"


def room_again(demand: Demand, port: Port) -> str:
    """After a step up."""
    takes = f"{_mb(demand.udp_bytes_s)} of {_mb(port.udp_bytes_s)} MB/s"
    return f"the link has room again: {what_goes(demand)} ({takes})"


def losses(share: float, demand: Demand, port: Port) -> str:
    """Why a demand that should fit does not."""
    return (
        f"{share:.0%} of the frames are lost although {_mb(demand.udp_bytes_s)} MB/s should fit "
        f"{_mb(port.udp_bytes_s)}; is a port slower than [link] says, or this PC too busy?"
    )


def no_way_down(demand: Demand, rig: LinkDemand, adapt: bool) -> str:
    """Overload that stays."""
    advice = "nothing smaller is offered" if adapt else "[link] adapt = false keeps it so"
    return f"{too_much(demand, rig)}: frames will be lost, {advice}"


def refusal(demand: Demand, fitting: Demand | None, rig: LinkDemand) -> str:
    """Why a camera is refused, and what would fit."""
    if fitting is None:
        return f"{too_much(demand, rig)}, and nothing that the agents offer would fit; use fewer cameras"
    takes = f"{_mb(fitting.udp_bytes_s)} MB/s"
    return (
        f"{too_much(demand, rig)}; [link] adapt = true would allow what fits: {what_goes(fitting)} ({takes})"
    )


def _mb(bytes_s: float) -> str:
    return f"{bytes_s / 1e6:.1f}"
