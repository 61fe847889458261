"""The Kinects on this machine's USB buses: found, told apart, checked before a driver takes them.

A Kinect is a hub with a camera and an audio device behind it (model 1414: and a motor). Cameras of
model 1473 and K4W report the serial number 000…0; the audio device beside them has a real one. It holds
their motor, too: usb/audio_motor.py.
"""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rig_agent.sources.base import SourceLost
from rig_agent.usb.audio_motor import AudioMotor
from rig_agent.usb.motor import Motor, NoMotor
from rig_agent.usb.motor_1414 import Motor1414
from rig_protocol.errors import ConfigurationError
from rig_protocol.troubleshooting import Topic

MICROSOFT = 0x045E
CAMERA_1414_1473, CAMERA_K4W = 0x02AE, 0x02BF
MOTOR_1414 = 0x02B0
AUDIO = (0x02AD, 0x02BE, 0x02BB, 0x02C3)
"""A 1414's and 1473's; a K4W's boot loader, and with firmware of the beta and of the last SDK."""
LOAD_FIRMWARE = (
    "put audios.bin into /usr/share/libfreenect and run `freenect-wavrecord` once after each power-on, "
    "before the agent (docs/control.md, Firmware)"
)
_REVISION_1414 = 0x010B  # of the device descriptor; libfreenect tells the models apart by it too

# The name that libfreenect is linked with, so that both ask one and the same library.
_LIBUSB = "libusb-1.0.so.0"

log = logging.getLogger(__name__)

_TOPICS = {"access": Topic.NO_PERMISSION, "busy": Topic.KINECT_IN_USE, "gone": Topic.NO_KINECT}

UsbDevice = Any
"""A `usb.core.Device`; pyusb ships no types."""


@dataclass(frozen=True, slots=True)
class KinectCamera:
    """One Kinect's camera on the bus.

    `index` counts the cameras in libusb's order, as libfreenect does. `serial` is None when it cannot
    be read. `port_path` is the kernel's name of the place, such as `1-2.1`.
    """

    index: int
    serial: str | None
    port_path: str
    model: str
    node: str
    device: UsbDevice

    def __str__(self) -> str:
        """For messages: what the operator reads on the label, and where to look."""
        return (
            f"Kinect {self.serial or 'without readable serial number'} ({self.model}) at USB {self.port_path}"
        )


def usb_devices() -> list[UsbDevice]:
    """Every Microsoft device, in libusb's order, freshly listed. ConfigurationError without libusb."""
    import usb.backend.libusb1 as libusb
    import usb.core

    # pyusb keeps its first libusb context, whose list is in order of plugging. Only a new context lists
    # the cameras in the order in which libfreenect's new context counts them.
    libusb._lib_object = None
    backend = libusb.get_backend(find_library=lambda _name: _LIBUSB)
    if backend is None:
        raise ConfigurationError(
            f"{_LIBUSB} cannot be loaded: apt install libusb-1.0-0", Topic.MISSING_LIBRARY
        )
    return list(usb.core.find(find_all=True, idVendor=MICROSOFT, backend=backend))


def kinect_cameras(devices: Iterable[UsbDevice]) -> list[KinectCamera]:
    """The cameras among the devices, with the serial number that identifies each Kinect."""
    listed = list(devices)
    cameras = [device for device in listed if device.idProduct in (CAMERA_1414_1473, CAMERA_K4W)]
    return [
        KinectCamera(
            index=index,
            serial=_identity(camera, listed),
            port_path=_port_path(camera),
            model=_model(camera),
            node=f"/dev/bus/usb/{camera.bus:03d}/{camera.address:03d}",
            device=camera,
        )
        for index, camera in enumerate(cameras)
    ]


def choose_camera(cameras: Sequence[KinectCamera], serial: str | None, port_path: str | None) -> KinectCamera:
    """The camera with this serial number and at this port, or the only one.

    `port_path` may name the camera (`1-2.1`) or the port that the Kinect's cable is in (`1-2`).
    SourceLost when it is not there, ConfigurationError when the choice is not clear.
    """
    found = [
        camera
        for camera in cameras
        if (serial is None or camera.serial == serial) and _is_at(camera.port_path, port_path)
    ]
    if len(found) == 1:
        return found[0]
    wanted = " ".join([*([serial] if serial else []), *([f"at USB {port_path}"] if port_path else [])])
    listed = "; ".join(map(str, found or cameras))
    if found:
        raise ConfigurationError(
            f"{len(found)} Kinects fit {wanted or 'an agent that names none'}: {listed}. "
            "Choose one with `serial` or `port_path` in [freenect]"
        )
    raise SourceLost(
        f"no Kinect {wanted} is connected, but {listed}. Plug it in, or correct [freenect]"
        if cameras
        else "no Kinect's camera is on the USB bus: check the cable and the Kinect's own power supply "
        "(`lsusb -d 045e:` lists it; motor without camera means: no power)",
        Topic.NO_KINECT,
    )


def motor_beside(camera: KinectCamera, devices: Iterable[UsbDevice]) -> Motor:
    """LED, tilt and accelerometer of the same Kinect; a NoMotor, which says why, where none can be asked."""
    beside = _beside(camera.device, devices)
    if camera.model == "1414":
        motor = next((device for device in beside if device.idProduct == MOTOR_1414), None)
        return Motor1414(motor) if motor else NoMotor("this Kinect shows no motor device: a bad plug or hub")
    audio = next((device for device in beside if device.idProduct in AUDIO), None)
    if audio is None:
        return NoMotor("this Kinect shows no audio device, which holds its motor: a bad plug or hub")
    if not firmware_runs(audio):
        return NoMotor(
            f"LED, tilt and accelerometer of a {camera.model} want firmware in its audio device, and none is "
            f"loaded (images need none): {LOAD_FIRMWARE}"
        )
    return AudioMotor(audio)


def firmware_runs(audio: UsbDevice) -> bool:
    """Whether a 1473's or K4W's audio device speaks for the motor: its boot loader has one interface only."""
    import usb.core

    try:
        return any(configuration.bNumInterfaces > 1 for configuration in audio.configurations())
    except usb.core.USBError:  # it vanished
        return False


def check_access(camera: KinectCamera) -> None:
    """SourceLost with what to do when this process may not use the camera or another one does."""
    import usb.core
    import usb.util

    try:
        if not camera.device.is_kernel_driver_active(0):  # libfreenect detaches that driver itself
            usb.util.claim_interface(camera.device, 0)
    except usb.core.USBError as error:
        raise SourceLost(_advice(camera, error), _TOPICS.get(_kind_of(error))) from error
    finally:
        usb.util.dispose_resources(camera.device)


def is_claimed(camera: KinectCamera) -> bool:
    """True when the camera is in use: proof that a driver opened this one and not its neighbour."""
    import usb.core
    import usb.util

    try:
        usb.util.claim_interface(camera.device, 0)
    except usb.core.USBError as error:
        return _kind_of(error) == "busy"
    finally:
        usb.util.dispose_resources(camera.device)
    return False


def reset(camera: KinectCamera) -> None:
    """Reset the camera's USB port, so that a firmware that stopped answering starts anew.

    Calls that wait for the device return with an error, also when the reset itself fails.
    """
    import usb.core
    import usb.util

    try:
        camera.device.reset()
    except usb.core.USBError as error:
        log.warning("%s could not be reset: %s", camera, error)
    finally:
        usb.util.dispose_resources(camera.device)


def _identity(camera: UsbDevice, listed: Sequence[UsbDevice]) -> str | None:
    own = _read_serial(camera)
    if own is None or own.strip("0"):
        return own
    audio = next((device for device in _beside(camera, listed) if device.idProduct in AUDIO), None)
    return None if audio is None else _read_serial(audio)


def _read_serial(device: UsbDevice) -> str | None:
    import usb.core
    import usb.util

    try:
        text: str | None = usb.util.get_string(device, device.iSerialNumber) if device.iSerialNumber else None
    except (usb.core.USBError, ValueError, NotImplementedError):  # ValueError: pyusb's name for no permission
        return None
    finally:
        usb.util.dispose_resources(device)
    return text


def _model(camera: UsbDevice) -> str:
    if camera.idProduct == CAMERA_K4W:
        return "K4W"
    return "1414" if camera.bcdDevice == _REVISION_1414 else "1473"


def _port_path(device: UsbDevice) -> str:
    return f"{device.bus}-{'.'.join(map(str, device.port_numbers or ()))}"


def _hub(device: UsbDevice) -> tuple[int, ...] | None:
    ports = tuple(device.port_numbers or ())
    return (device.bus, *ports[:-1]) if ports else None


def _beside(camera: UsbDevice, devices: Iterable[UsbDevice]) -> list[UsbDevice]:
    """What is behind the same hub, which is the Kinect's own."""
    hub = _hub(camera)
    return [] if hub is None else [device for device in devices if _hub(device) == hub]


def _is_at(port_path: str, wanted: str | None) -> bool:
    return wanted is None or port_path == wanted or port_path.startswith(f"{wanted}.")


def _kind_of(error: Any) -> str:
    """What a USBError means; libusb's codes are the same on every platform, errno is not always set."""
    return {-3: "access", -6: "busy", -4: "gone"}.get(error.backend_error_code, "other")


def _advice(camera: KinectCamera, error: Any) -> str:
    match _kind_of(error):
        case "access":
            return (
                f"{camera} may not be opened ({camera.node}): install the udev rules of deploy/udev, run "
                "`sudo udevadm control --reload && sudo udevadm trigger` and plug the Kinect in again"
            )
        case "busy":
            return (
                f"{camera} is in use by another program: stop the other agent or viewer; the kernel's "
                "driver is removed with `sudo rmmod gspca_kinect` and kept away by blacklisting it"
            )
        case "gone":
            return f"{camera} vanished while it was being opened"
        case _:
            return f"{camera} cannot be opened: {error}"
