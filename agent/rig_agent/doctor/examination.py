"""The checks one after another, each with a limit of its own: a device that hangs holds up nothing else."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from rig_agent.config import AgentSettings
from rig_agent.doctor.clock import clock
from rig_agent.doctor.disk import disk
from rig_agent.doctor.finding import Check, Finding, failed
from rig_agent.doctor.frames import frames
from rig_agent.doctor.kernel import kernel
from rig_agent.doctor.libraries import libraries
from rig_agent.doctor.machine import Machine
from rig_agent.doctor.network import network
from rig_agent.doctor.power import power, processor
from rig_agent.doctor.server import server
from rig_agent.doctor.usb import usb
from rig_agent.sources.base import SourceDescription
from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import Topic

_LIMIT_S = 10.0  # the resolver's own limit is the longest of all
_USB_LIMIT_S = 10.0  # reading a serial number may take a second a Kinect
_SOURCE_LIMIT_S = 60.0  # a simulated room on a slow processor; drivers have limits of their own

Look = Callable[[], list[Finding]]


@dataclass(frozen=True, slots=True)
class _Step:
    """One look; `blamed` is the check that fails when it does not end, or breaks."""

    blamed: Check
    look: Look
    limit_s: float = _LIMIT_S


def examine(machine: Machine, settings: AgentSettings) -> Iterator[Finding]:
    """Everything that the settings' source needs; a finding comes as soon as it is known."""
    described: list[SourceDescription] = []

    def look_at_frames() -> list[Finding]:
        finding, description = frames(machine, settings)
        if description is not None:
            described.append(description)
        return [finding]

    def look_at_server() -> list[Finding]:
        return server(machine, settings, described[0] if described else None)

    machines_own = [
        _Step(Check.POWER, partial(power, machine, settings)),
        _Step(Check.TEMPERATURE, partial(processor, machine, settings)),
        _Step(Check.SPACE, partial(disk, machine, settings)),
        _Step(Check.PYTHON, partial(libraries, machine, settings)),
    ]
    kinect = [
        _Step(Check.RULES, partial(kernel, machine, settings)),
        _Step(Check.KINECT, partial(usb, machine, settings), _USB_LIMIT_S),
    ]
    rig = [
        _Step(Check.FRAMES, look_at_frames, _SOURCE_LIMIT_S),
        _Step(Check.CLOCK_SYNCHRONISED, partial(clock, machine, settings)),
        _Step(Check.SERVER_NAME, partial(network, machine, settings)),
        _Step(Check.SERVER, look_at_server),
    ]
    for step in (*machines_own, *(kinect if settings.source == "freenect" else ()), *rig):
        yield from _take(step)


def _take(step: _Step) -> list[Finding]:
    found: list[Finding] = []
    # A daemon: a call that never returns must not keep the program from ending.
    thread = threading.Thread(target=lambda: found.extend(_look(step)), name=step.blamed, daemon=True)
    thread.start()
    thread.join(step.limit_s)
    if found:
        return found
    text = f"no answer within {step.limit_s:g} s: the device or its driver hangs"
    hardware = step.blamed in (Check.KINECT, Check.FRAMES)
    return [failed(step.blamed, text, "dmesg | tail", Topic.HANGING_KINECT, hardware)]


def _look(step: _Step) -> list[Finding]:
    try:
        return step.look()
    except RigError as error:
        return [failed(step.blamed, str(error), topic=error.topic)]
    except Exception as error:  # one check that breaks must not take the others with it
        return [failed(step.blamed, f"this check itself broke: {error!r}", topic=Topic.OTHER_FAILURES)]
