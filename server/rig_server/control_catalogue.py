"""The controls that there are, for people: what the operator may write, and what it means."""

from dataclasses import dataclass
from typing import Literal

from rig_protocol.errors import ConfigurationError
from rig_protocol.messages import ControlValue

Kind = Literal["switch", "number", "word", "action"]

IDENTIFYING, ORDINARY = "blink_red_yellow", "green"
"""What `led` is set to while a camera shows which it is, and else."""

_SWITCH_WORDS = {"on": True, "true": True, "yes": True, "off": False, "false": False, "no": False}


@dataclass(frozen=True, slots=True)
class ControlEntry:
    """One control: its name, what its value is, and what it does."""

    name: str
    kind: Kind
    values: str
    meaning: str


CATALOGUE = (
    ControlEntry(
        "led",
        "word",
        "off, green, red, yellow, blink_green, blink_red_yellow",
        "the Kinect's lamp",
    ),
    ControlEntry("tilt_deg", "number", "-27 to 27", "the motor's tilt; not in a ring that was calibrated"),
    ControlEntry("auto_exposure", "switch", "on, off", "whether the colour camera sets its exposure"),
    ControlEntry("auto_white_balance", "switch", "on, off", "whether it sets its white balance"),
    ControlEntry("near_mode", "switch", "on, off", "depth from 0.4 m on (Kinect for Windows only)"),
    ControlEntry("mirror", "switch", "on, off", "images as a mirror shows them"),
    ControlEntry("color", "word", "bayer, rgb, ir", "what the colour stream carries"),
    ControlEntry("depth", "switch", "on, off", "the depth stream and its infrared projector"),
    ControlEntry("restart", "action", "stream, device, usb", "start the streams, or more, anew; else stream"),
    ControlEntry("reopen_source", "action", "", "close the device and open it again (any source)"),
    ControlEntry("restart_agent", "action", "", "start the agent's program anew"),
    ControlEntry("log_level", "word", "DEBUG, INFO, WARNING, ERROR", "what is worth a line in its log"),
)
_KINDS = {entry.name: entry.kind for entry in CATALOGUE}


def parse_value(name: str, text: str | None) -> ControlValue:
    """What an operator wrote as the value that an agent takes; ConfigurationError where it cannot be one.

    A control that we do not know (a newer agent may) takes on, off, a number or a word.
    """
    kind = _KINDS.get(name)
    if text is None:
        if kind not in (None, "action"):
            raise ConfigurationError(f"{name} needs a value ({kind}): rig-server control --list")
        return True
    word = text.strip()
    if kind in ("word", "action"):
        return word
    if kind != "number" and word.lower() in _SWITCH_WORDS:
        return _SWITCH_WORDS[word.lower()]
    try:
        return float(word)
    except ValueError:
        if kind is None:
            return word
    raise ConfigurationError(f"{name} takes {'a number' if kind == 'number' else 'on or off'}, not {text!r}")
