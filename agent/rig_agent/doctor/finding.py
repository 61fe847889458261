"""What the doctor finds: one verdict a check, with the command that mends it."""

from dataclasses import dataclass
from enum import StrEnum

from rig_protocol.troubleshooting import Topic, reference


class Status(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


class Check(StrEnum):
    """What is looked at; the values are stable keys (docs/check.md)."""

    POWER = "power"
    GOVERNOR = "processor.governor"
    TEMPERATURE = "processor.temperature"
    SPACE = "disk.space"
    WRITABLE = "disk.writable"
    PYTHON = "library.python"
    LIBFREENECT = "library.libfreenect"
    LIBUSB = "library.libusb"
    OPENNI2 = "library.openni2"
    RULES = "usb.rules"
    WEBCAM_DRIVER = "usb.webcam_driver"
    KINECT = "usb.kinect"
    FUNCTIONS = "usb.functions"
    SPEED = "usb.speed"
    CONTROLLER = "usb.controller"
    PERMISSION = "usb.permission"
    AUTOSUSPEND = "usb.autosuspend"
    FIRMWARE = "usb.firmware"
    FRAMES = "source.frames"
    CLOCK_SYNCHRONISED = "clock.synchronised"
    CLOCK_SOURCE = "clock.source"
    SERVER_NAME = "network.name"
    MTU = "network.mtu"
    LINK_SPEED = "network.speed"
    BUFFERS = "network.buffers"
    KEY = "server.key"
    SERVER = "server.answer"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report. `hardware`: only hands can mend it (a cable, a Kinect, a power supply)."""

    check: Check
    status: Status
    text: str
    mend: str | None = None
    hardware: bool = False
    topic: Topic | None = None

    def to_dict(self) -> dict[str, object]:
        """As `--json` prints it; what was skipped is no trouble, and says so in a key of its own."""
        is_skipped = self.status == Status.SKIPPED
        return {
            "name": self.check.value,
            "status": (Status.OK if is_skipped else self.status).value,
            "message": self.text,
            "fix": self.mend,
            "skipped": is_skipped,
            "hardware": self.hardware,
            "see": None if self.topic is None else reference(self.topic).removeprefix("see "),
        }


def ok(check: Check, text: str) -> Finding:
    """All is well."""
    return Finding(check, Status.OK, text)


def skipped(check: Check, text: str) -> Finding:
    """There is nothing to look at here; `text` says why."""
    return Finding(check, Status.SKIPPED, text)


def warning(
    check: Check, text: str, mend: str | None = None, topic: Topic | None = None, hardware: bool = False
) -> Finding:
    """The rig runs, worse than it could."""
    return Finding(check, Status.WARNING, text, mend, hardware, topic)


def failed(
    check: Check, text: str, mend: str | None = None, topic: Topic | None = None, hardware: bool = False
) -> Finding:
    """The rig does not run like this."""
    return Finding(check, Status.FAILED, text, mend, hardware, topic)
