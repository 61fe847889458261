"""A Raspberry Pi that is in order, as files below a folder: what the doctor looks at."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rig_agent.doctor.machine import Machine
from rig_protocol.system_clock import KernelClock

CAMERA, CAMERA_K4W, MOTOR, AUDIO, AUDIO_K4W = 0x02AE, 0x02BF, 0x02B0, 0x02AD, 0x02BE
HIGH_SPEED, FULL_SPEED = 3, 2

_FILES = {
    "/proc/device-tree/model": "Raspberry Pi 4 Model B Rev 1.4\0",
    "/proc/modules": "snd_usb_audio 299008 0 - Live 0x0\n",
    "/proc/mounts": "/dev/mmcblk0p2 / ext4 rw,noatime 0 0\n",
    "/proc/net/route": (
        "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT\n"
        "wlan0\t00000000\t0100A8C0\t0003\t0\t0\t600\t00000000\t0\t0\t0\n"
        "eth0\t0000000A\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0\n"
    ),
    "/proc/self/maps": "",
    "/proc/sys/net/core/rmem_default": "212992",
    "/proc/sys/net/core/wmem_default": "212992",
    "/sys/devices/platform/soc/soc:firmware/get_throttled": "0",
    "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "ondemand",
    "/sys/devices/system/clocksource/clocksource0/current_clocksource": "arch_sys_counter",
    "/sys/class/thermal/thermal_zone0/temp": "48312",
    "/sys/class/net/eth0/mtu": "1500",
    "/sys/class/net/eth0/speed": "1000",
    "/sys/class/net/eth0/duplex": "full",
    "/sys/class/net/wlan0/mtu": "1500",
    "/sys/class/net/wlan0/wireless/link": "",
    "/sys/bus/usb/devices/1-1.1/power/control": "on",
    "/etc/udev/rules.d/60-kinect-rig.rules": 'ATTR{idVendor}!="045e"\nATTR{idProduct}!="02ae|02bf"\n',
    "/etc/modprobe.d/kinect-rig-blacklist.conf": "# a reason\nblacklist gspca_kinect\n",
    "/run/chrony/chronyd.pid": "412",
    "/var/log/syslog": "",
}


def device(
    product: int, ports: tuple[int, ...], revision: int = 0x010B, bus: int = 1, interfaces: int = 1
) -> Any:
    """A device as pyusb describes it; it has no serial number."""
    return SimpleNamespace(
        idProduct=product,
        bcdDevice=revision,
        bus=bus,
        address=10 * ports[0] + ports[-1],
        port_numbers=ports,
        iSerialNumber=0,
        speed=HIGH_SPEED,
        configurations=lambda: (SimpleNamespace(bNumInterfaces=interfaces),),
    )


def kinect_1414(hub: int = 1, bus: int = 1) -> list[Any]:
    """The three functions behind the hub of a Kinect."""
    return [
        device(CAMERA, (hub, 1), bus=bus),
        device(MOTOR, (hub, 2), bus=bus),
        device(AUDIO, (hub, 3), bus=bus),
    ]


def _absent(name: str) -> Any:
    raise OSError(f"{name}: cannot open shared object file")


class PiTree:
    """Write to it what shall be different, then ask for the machine."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for path, text in _FILES.items():
            self.write(path, text)

    def write(self, path: str, text: str) -> None:
        """Set a file."""
        place = self.root / path.lstrip("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)

    def remove(self, path: str) -> None:
        """Take a file away."""
        (self.root / path.lstrip("/")).unlink()

    def machine(self, **answers: Any) -> Machine:
        """The Pi with one healthy Kinect; `answers` replace fields of Machine."""
        healthy: dict[str, Any] = {
            "root": self.root,
            "command_output": lambda _words: None,
            "may_open": lambda _node: True,
            "free_bytes": lambda _folder: 20 << 30,
            "usb_devices": kinect_1414,
            "check_access": lambda _camera: None,
            # Never the real ones: they would shut the virtual USB bus out of this process.
            "load_library": _absent,
            "load_libfreenect": lambda _path: None,
            "kernel_clock": lambda: KernelClock(True, 800, 20),
        }
        return Machine(**(healthy | answers))
