"""The Kinect on the USB bus: all its functions there, alone on its controller, ours to open."""

import os
from collections.abc import Sequence
from pathlib import Path

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, Status, failed, ok, warning
from rig_agent.doctor.machine import Machine
from rig_agent.sources.base import SourceLost
from rig_agent.usb import enumerate as usb_bus
from rig_agent.usb.enumerate import KinectCamera, UsbDevice
from rig_protocol.errors import ConfigurationError
from rig_protocol.troubleshooting import Topic

_HIGH_SPEED = 3  # of libusb's enum; 480 Mbit/s
_REPLUG_RULES = "sudo udevadm control --reload && sudo udevadm trigger"
_FIRMWARE = "audios.bin"
_FIRMWARE_FOLDERS = ("/usr/local/share/libfreenect", "/usr/share/libfreenect")  # as libfreenect looks
_LOAD_FIRMWARE = (
    "sudo apt install libfreenect-bin && sudo systemctl stop 'rig-agent@*' && cd /tmp && "
    "sudo timeout 20 freenect-wavrecord"
)


def usb(machine: Machine, settings: AgentSettings) -> list[Finding]:
    """Everything about the Kinect that this agent uses, and about its neighbours on this machine."""
    devices = machine.usb_devices()
    cameras = usb_bus.kinect_cameras(devices)
    wanted = settings.freenect
    try:
        camera = usb_bus.choose_camera(cameras, wanted.serial, wanted.port_path)
    except SourceLost as error:
        return [_absent(devices, cameras, error)]
    except ConfigurationError as error:
        mend = "sudoedit /etc/kinect-rig/cam*.toml"
        return [failed(Check.KINECT, str(error), mend, error.topic), *_controllers(cameras)]
    beside = [device for device in devices if _hub(device) == _hub(camera.device)]
    return [
        ok(Check.KINECT, str(camera)),
        _functions(camera, beside),
        _speed(camera),
        *_controllers(cameras),
        _permission(machine, camera, beside),
        *_autosuspend(machine, camera),
        *_firmware(machine, camera, beside),
    ]


def _absent(devices: Sequence[UsbDevice], cameras: Sequence[KinectCamera], error: SourceLost) -> Finding:
    text = str(error)
    if not cameras and any(device.idProduct in (usb_bus.MOTOR_1414, *usb_bus.AUDIO) for device in devices):
        text = "a Kinect's motor or audio answers, its camera does not: its own 12-V supply is missing"
    return failed(Check.KINECT, text, "lsusb -d 045e:", Topic.NO_KINECT, hardware=True)


def _functions(camera: KinectCamera, beside: Sequence[UsbDevice]) -> Finding:
    present = {device.idProduct for device in beside}
    missing = [] if present & set(usb_bus.AUDIO) else ["audio"]
    if camera.model == "1414" and usb_bus.MOTOR_1414 not in present:  # later ones have it behind the audio
        missing.append("motor")
    if missing:
        return warning(
            Check.FUNCTIONS,
            f"the Kinect at USB {camera.port_path} shows no {' and no '.join(missing)}: a bad plug or "
            "adapter, or a hub in between",
            "unplug both of the Kinect's plugs, wait five seconds, plug them in again",
            Topic.NO_KINECT,
            hardware=True,
        )
    return ok(Check.FUNCTIONS, "camera, motor and audio are there")


def _speed(camera: KinectCamera) -> Finding:
    if camera.device.speed >= _HIGH_SPEED:
        return ok(Check.SPEED, "the camera runs at 480 Mbit/s")
    return failed(
        Check.SPEED,
        "the camera came up at 12 Mbit/s, which carries no images: a bad plug, cable or hub",
        "plug the Kinect into the Pi directly, into another port",
        Topic.NO_FRAMES,
        hardware=True,
    )


def _controllers(cameras: Sequence[KinectCamera]) -> list[Finding]:
    """One Kinect fills more than half of a USB 2 bus; each bus has a controller of its own."""
    buses = [camera.device.bus for camera in cameras]
    shared = sorted({bus for bus in buses if buses.count(bus) > 1})
    if shared:
        return [
            failed(
                Check.CONTROLLER,
                f"{buses.count(shared[0])} Kinects share the controller of USB bus {shared[0]}, "
                "which carries the images of one",
                "plug each Kinect into another controller (`lsusb -t` shows them), or another Pi",
                Topic.TORN_FRAMES,
                hardware=True,
            )
        ]
    return [ok(Check.CONTROLLER, "no two Kinects share a USB controller")]


def _permission(machine: Machine, camera: KinectCamera, beside: Sequence[UsbDevice]) -> Finding:
    try:
        machine.check_access(camera)
    except SourceLost as error:
        match error.topic:
            case Topic.KINECT_IN_USE if machine.runs("rig-agent"):
                return ok(Check.PERMISSION, "the rig-agent that runs here has the camera")
            case Topic.KINECT_IN_USE:
                mend = "sudo systemctl stop 'rig-agent@*' && sudo rmmod gspca_kinect"
            case Topic.NO_PERMISSION:
                mend = _REPLUG_RULES
            case _:
                return failed(Check.PERMISSION, str(error), "dmesg | tail", error.topic, hardware=True)
        return failed(Check.PERMISSION, str(error), mend, error.topic)
    closed = [node for node in map(_node, beside) if _is_closed(machine, node)]
    if closed:
        text = f"this user may open the camera but not {', '.join(closed)}"
        return warning(Check.PERMISSION, text, _REPLUG_RULES, Topic.NO_PERMISSION)
    return ok(Check.PERMISSION, "this user may open the Kinect")


def _node(device: UsbDevice) -> str:
    return f"/dev/bus/usb/{device.bus:03d}/{device.address:03d}"


def _is_closed(machine: Machine, node: str) -> bool:
    path = machine.path(node)
    return path.exists() and not machine.may_open(path)


def _autosuspend(machine: Machine, camera: KinectCamera) -> list[Finding]:
    control = f"/sys/bus/usb/devices/{camera.port_path}/power/control"
    match machine.text(control):
        case None:
            return []
        case "on":
            return [ok(Check.AUTOSUSPEND, "the kernel keeps the Kinect awake")]
    text = "the kernel may send the Kinect to sleep, from which it comes back late or never"
    return [warning(Check.AUTOSUSPEND, text, f"echo on | sudo tee {control}", Topic.NO_FRAMES)]


def _firmware(machine: Machine, camera: KinectCamera, beside: Sequence[UsbDevice]) -> list[Finding]:
    """Models 1473 and K4W have LED, tilt and accelerometer behind an audio device that wants firmware."""
    if camera.model == "1414":
        return []
    if any(device.idProduct in usb_bus.AUDIO and usb_bus.firmware_runs(device) for device in beside):
        return [
            ok(Check.FIRMWARE, f"firmware runs in the audio device: this {camera.model} has LED and tilt")
        ]
    places = [machine.path(f"{folder}/{_FIRMWARE}") for folder in _FIRMWARE_FOLDERS]
    if own := os.environ.get("LIBFREENECT_FIRMWARE_PATH"):
        places.insert(0, Path(own, _FIRMWARE))
    found = next((place for place in places if place.is_file()), None)
    if found is not None:
        text = f"{found} is not loaded (again after each power-on): images need none"
        mend = _LOAD_FIRMWARE
    else:
        text = "no audio firmware: images need none (where to get it: docs/control.md, Firmware)"
        mend = f"sudo install -Dt /usr/share/libfreenect audios.bin && {_LOAD_FIRMWARE}"
    text += f"; LED, tilt and accelerometer of a {camera.model} do"
    return [Finding(Check.FIRMWARE, Status.SKIPPED, text, mend)]


def _hub(device: UsbDevice) -> tuple[int, ...]:
    """Where the Kinect's own hub is plugged in."""
    return (device.bus, *tuple(device.port_numbers or ())[:-1])
