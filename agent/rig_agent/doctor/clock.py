"""The clocks: whether a time source disciplines this machine's, and what counts its ticks."""

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, ok, skipped, warning
from rig_agent.doctor.machine import Machine
from rig_protocol.troubleshooting import Topic

_DAEMONS = {"chrony": "/run/chrony/chronyd.pid", "systemd-timesyncd": "/run/systemd/timesync/synchronized"}
_SOURCE = "/sys/devices/system/clocksource/clocksource0/current_clocksource"
_SLOW_SOURCES = ("jiffies", "hpet", "acpi_pm", "pit", "refined-jiffies")


def clock(machine: Machine, settings: AgentSettings) -> list[Finding]:
    """System clock and clock source."""
    return [_synchronised(machine, settings.address[0]), _source(machine)]


def _synchronised(machine: Machine, server: str) -> Finding:
    running = [name for name, path in _DAEMONS.items() if machine.path(path).exists()]
    by = f" by {running[0]}" if running else ""
    if machine.kernel_clock().synchronised:
        return ok(Check.CLOCK_SYNCHRONISED, f"the system clock is disciplined{by}")
    mend = (
        "grep -r rtcsync /etc/chrony && chronyc sources"
        if running == ["chrony"]
        else f"sudo apt install chrony && echo 'server {server} iburst' "
        "| sudo tee /etc/chrony/sources.d/rig.sources && sudo chronyc reload sources"
    )
    return warning(
        Check.CLOCK_SYNCHRONISED,
        f"nothing disciplines the system clock{' yet,' + by if by else ''}: frames are timed by the "
        "server's exchange alone, to some tenths of a millisecond",
        mend,
        Topic.UNCERTAIN_CLOCK,
    )


def _source(machine: Machine) -> Finding:
    source = machine.text(_SOURCE)
    if source is None:
        return skipped(Check.CLOCK_SOURCE, "the kernel does not tell its clock source")
    if source in _SLOW_SOURCES:
        return warning(
            Check.CLOCK_SOURCE,
            f"the kernel counts time by {source}, slowly and coarsely",
            "cat /sys/devices/system/clocksource/clocksource0/available_clocksource",
            Topic.UNCERTAIN_CLOCK,
        )
    return ok(Check.CLOCK_SOURCE, f"the kernel counts time by {source}")
