"""What the system does to a Kinect when it is plugged in: udev rules, and a webcam driver that grabs it."""

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok, warning
from rig_agent.doctor.machine import Machine
from rig_agent.usb.enumerate import CAMERA_1414_1473, CAMERA_K4W
from rig_protocol.troubleshooting import Topic

_RULES_FOLDERS = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
_MODPROBE_FOLDERS = ("/etc/modprobe.d", "/run/modprobe.d", "/usr/lib/modprobe.d", "/lib/modprobe.d")
_WEBCAM_DRIVER = "gspca_kinect"


def kernel(machine: Machine, _settings: AgentSettings) -> list[Finding]:
    """Rules and webcam driver."""
    return [_rules(machine), _webcam_driver(machine)]


def _rules(machine: Machine) -> Finding:
    cameras = [f"{product:04x}" for product in (CAMERA_1414_1473, CAMERA_K4W)]
    rules = [text for text in machine.files(_RULES_FOLDERS, "*.rules") if "045e" in text]
    if all(any(camera in text for text in rules) for camera in cameras):
        return ok(Check.RULES, "udev rules open every model of Kinect")
    return warning(
        Check.RULES,
        "no udev rules open every model of Kinect (libfreenect's own leave out Kinect for Windows)",
        "sudo install -m 644 deploy/udev/60-kinect-rig.rules /etc/udev/rules.d/ "
        "&& sudo udevadm control --reload && sudo udevadm trigger",
        Topic.NO_PERMISSION,
    )


def _webcam_driver(machine: Machine) -> Finding:
    modules = machine.text("/proc/modules") or ""
    if any(line.split()[0] == _WEBCAM_DRIVER for line in modules.splitlines()):
        return failed(
            Check.WEBCAM_DRIVER,
            f"the kernel's webcam driver {_WEBCAM_DRIVER} is loaded and grabs the camera",
            f"sudo rmmod {_WEBCAM_DRIVER}",
            Topic.KINECT_IN_USE,
        )
    lines = [
        line.split() for text in machine.files(_MODPROBE_FOLDERS, "*.conf") for line in text.splitlines()
    ]
    if ["blacklist", _WEBCAM_DRIVER] in lines:
        return ok(Check.WEBCAM_DRIVER, f"{_WEBCAM_DRIVER} is kept away")
    return warning(
        Check.WEBCAM_DRIVER,
        f"{_WEBCAM_DRIVER} is not loaded, but the next plug may load it",
        "sudo install -m 644 deploy/udev/kinect-rig-blacklist.conf /etc/modprobe.d/",
        Topic.KINECT_IN_USE,
    )
