"""Whether the source delivers: it is opened as the agent would open it, and read."""

import time

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok, skipped, warning
from rig_agent.doctor.machine import Machine
from rig_agent.sources.base import FrameSource, SourceDescription
from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import Topic

_FIRST_FRAME_S = 15.0  # a folder may be played at a frame in ten seconds
_LIVE_FRAMES = 30
_MANY_DAMAGED = 0.1
_HARDWARE = {Topic.NO_FRAMES, Topic.HANGING_KINECT}


def frames(machine: Machine, settings: AgentSettings) -> tuple[Finding, SourceDescription | None]:
    """The verdict, and what the source says of itself; None when it could not be opened."""
    description = None
    try:
        with machine.open_source(settings) as source:
            description = source.describe()
            return _read(source, settings.source), description
    except RigError as error:
        if error.topic == Topic.KINECT_IN_USE and machine.runs("rig-agent"):
            return skipped(Check.FRAMES, "the rig-agent that runs here reads them"), description
        if error.topic == Topic.NO_KINECT and settings.source == "freenect":
            return skipped(Check.FRAMES, f"there is no Kinect to read ({Check.KINECT})"), description
        hardware = error.topic in _HARDWARE
        mend = None if hardware else "rig-agent --print-config"
        return failed(Check.FRAMES, str(error), mend, error.topic, hardware), description


def _read(source: FrameSource, name: str) -> Finding:
    """One frame of a source that makes them, a second's frames of a device."""
    wanted = 1 if name in ("folder", "recording", "synthetic") else _LIVE_FRAMES
    whole = damaged = 0
    end_s = time.monotonic() + _FIRST_FRAME_S
    while whole + damaged < wanted and time.monotonic() < end_s:
        frame = source.read(1.0)
        if frame is not None:
            damaged += frame.damaged
            whole += not frame.damaged
    if whole + damaged < wanted:
        text = f"only {whole + damaged} of {wanted} frames came within {_FIRST_FRAME_S:.0f} s"
        return failed(Check.FRAMES, text, None, Topic.NO_FRAMES, hardware=name not in ("folder", "recording"))
    if damaged > _MANY_DAMAGED * wanted:
        return warning(
            Check.FRAMES,
            f"{damaged} of {wanted} frames lost USB packets",
            "put the Kinect alone on its USB controller, without a hub",
            Topic.TORN_FRAMES,
            hardware=True,
        )
    return ok(Check.FRAMES, f"source {name} delivers: {whole} of {wanted} frames whole")
