"""The C interface, as far as it shows without a Kinect."""

import ctypes
import ctypes.util
import subprocess
import sys
from pathlib import Path

import pytest

from rig_agent.sources.freenect_device import DamageReport
from rig_agent.sources.libfreenect import FrameMode, RegistrationStruct, load_libfreenect
from rig_protocol.errors import ConfigurationError


def test_structs_have_the_sizes_and_offsets_of_the_c_compiler() -> None:
    # sizeof and offsetof of libfreenect 0.5's headers, the same on x86-64 and aarch64.
    assert ctypes.sizeof(FrameMode) == 24
    assert ctypes.sizeof(RegistrationStruct) == 176
    assert RegistrationStruct.emitter_distance_cm.offset == 124
    assert RegistrationStruct.const_shift.offset == 144


def test_a_library_that_is_not_libfreenect_is_refused_by_name() -> None:
    other = ctypes.util.find_library("m")
    if other is None:
        pytest.skip("no C mathematics library to take for libfreenect")
    with pytest.raises(ConfigurationError, match="no usable libfreenect: it lacks freenect_init"):
        load_libfreenect(Path(other))


def test_importing_the_source_loads_no_driver() -> None:
    program = (
        "import sys, rig_agent.sources.freenect as freenect; freenect.FreenectSettings(); "
        "maps = open('/proc/self/maps').read(); "
        "sys.exit('usb' in sys.modules or 'libfreenect' in maps or 'libusb' in maps)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def report_of(*lines: bytes) -> DamageReport:
    report = DamageReport()
    for line in lines:
        report.read(line)
    return report


@pytest.mark.parametrize(("arrived", "damaged"), [(242, False), (241, True), (0, True)])
def test_a_frame_is_whole_when_all_its_packets_arrived(arrived: int, damaged: bool) -> None:
    line = b"Got depth frame of size 422400/422400, %d/242 packets arrived, TS 00a3b4c5\n" % arrived
    assert report_of(line).is_damaged("depth") is damaged


def test_damage_of_one_stream_leaves_the_other_whole() -> None:
    report = report_of(
        b"Got video frame of size 307200/307200, 160/162 packets arrived, TS 00a3b4c5\n",
        b"Got depth frame of size 422400/422400, 242/242 packets arrived, TS 00a3b4c5\n",
    )
    assert not report.is_damaged("depth")
    assert report.is_damaged("video")


def test_a_short_packet_damages_the_frame_that_it_may_belong_to() -> None:
    whole = b"Got depth frame of size 422400/422400, 242/242 packets arrived, TS 0\n"
    report = report_of(b"[Stream 70] Expected 1748 data bytes, but got 12\n")
    verdicts = []
    for _ in range(3):
        report.read(whole)
        verdicts.append(report.is_damaged("depth"))
    assert verdicts == [True, True, False]


def test_a_frame_of_unknown_wholeness_is_counted() -> None:
    report = report_of(b"some other line\n")
    assert not report.is_damaged("video")
    assert report.unreported == 1
