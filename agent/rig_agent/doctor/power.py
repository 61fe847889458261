"""Supply, heat and governor of the processor; a Raspberry Pi tells about its supply, too."""

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok, skipped, warning
from rig_agent.doctor.machine import Machine
from rig_protocol.troubleshooting import Topic

_MODEL = "/proc/device-tree/model"
_THROTTLED = "/sys/devices/platform/soc/soc:firmware/get_throttled"
_GOVERNOR = "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
_TEMPERATURE = "/sys/class/thermal/thermal_zone0/temp"  # in 1/1000 °C

# Bits of get_throttled (Raspberry Pi documentation, vcgencmd); the same 16 bits higher: since the start.
_BITS = {
    0x1: "its supply's voltage is too low",
    0x2: "its clock is capped",
    0x4: "it is throttled",
    0x8: "it is too hot",
}
_SINCE_START = 16
_HOT_C = 80.0  # a Pi throttles from here on


def power(machine: Machine, _settings: AgentSettings) -> list[Finding]:
    """Whether the Pi has enough power now, and had since it started."""
    model = machine.text(_MODEL) or ""
    if "Raspberry Pi" not in model:
        return [skipped(Check.POWER, "this is not a Raspberry Pi")]
    flags = _throttled(machine)
    if flags is None:
        return [skipped(Check.POWER, f"{model} does not tell: vcgencmd may not be run by this user")]
    now, before = _names(flags), _names(flags >> _SINCE_START)
    advice = "use the Pi's own supply and a short cable, and cool it"
    if now:
        return [failed(Check.POWER, f"{model}: {now} now", advice, Topic.POWER, hardware=True)]
    if before:
        text = f"{model}: since it started, at times {before}"
        return [warning(Check.POWER, text, advice, Topic.POWER, hardware=True)]
    return [ok(Check.POWER, f"{model}: enough power since it started")]


def processor(machine: Machine, _settings: AgentSettings) -> list[Finding]:
    """Whether the processor runs as fast as it can."""
    return [_governor(machine), _temperature(machine)]


def _governor(machine: Machine) -> Finding:
    governor = machine.text(_GOVERNOR)
    if governor is None:
        return skipped(Check.GOVERNOR, "this machine does not tell how it governs its clock")
    if governor == "powersave" and machine.text(_GOVERNOR.replace("governor", "driver")) != "intel_pstate":
        return warning(
            Check.GOVERNOR,
            "the processor stays at its lowest clock (powersave)",
            "echo ondemand | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
            Topic.LOW_RATE,
        )
    return ok(Check.GOVERNOR, f"the processor's clock follows its load ({governor})")


def _temperature(machine: Machine) -> Finding:
    thousandths = machine.number(_TEMPERATURE)
    if thousandths is None:
        return skipped(Check.TEMPERATURE, "this machine does not tell its temperature")
    celsius = thousandths / 1000
    if celsius >= _HOT_C:
        text = f"the processor has {celsius:.0f} °C and slows down"
        return warning(Check.TEMPERATURE, text, "cool it", Topic.POWER, hardware=True)
    return ok(Check.TEMPERATURE, f"the processor has {celsius:.0f} °C")


def _throttled(machine: Machine) -> int | None:
    """The flags by sysfs ("50005"), else by the firmware's own tool ("throttled=0x50005")."""
    text = machine.text(_THROTTLED) or machine.command_output(["vcgencmd", "get_throttled"]) or ""
    try:
        return int(text.rpartition("=")[2], 16)
    except ValueError:
        return None


def _names(flags: int) -> str:
    return ", ".join(name for bit, name in _BITS.items() if flags & bit)
