"""`rig-agent --check` as a program: the real libfreenect and libusb on a virtual USB bus."""

import json
import subprocess
import sys
from typing import Any

import pytest

from support.loopback_server import LoopbackServer
from support.virtual_usb.virtual_bus import VirtualBus, environment

SERIAL = "A00364A11111111A"


def check(bus: VirtualBus, rig: LoopbackServer) -> tuple[int, dict[str, dict[str, Any]], dict[str, Any]]:
    server = f"{rig.address[0]}:{rig.address[1]}"
    words = ["--check", "--json", "--server", server, "--camera", "0", "--insecure"]
    done = subprocess.run(
        [sys.executable, "-m", "rig_agent.cli", *words],
        capture_output=True,
        text=True,
        timeout=120,
        env=environment(bus),
        cwd=bus.folder,
    )
    assert "Traceback" not in done.stderr, done.stderr
    told = json.loads(done.stdout)
    return done.returncode, {finding["name"]: finding for finding in told["checks"]}, told


@pytest.mark.parametrize(("model", "serial"), [("1414", SERIAL), ("1473", SERIAL), ("k4w", SERIAL)])
def test_a_healthy_kinect_passes_and_delivers(usb_bus: VirtualBus, model: str, serial: str) -> None:
    usb_bus.add_kinect(serial, model=model)
    with LoopbackServer() as rig:
        _, found, _ = check(usb_bus, rig)
    for name in ("usb.kinect", "usb.functions", "usb.speed", "usb.controller", "usb.permission"):
        assert found[name]["status"] == "ok", found[name]
    assert serial in found["usb.kinect"]["message"]
    assert found["source.frames"]["status"] == "ok", found["source.frames"]
    assert "libusb 1.0.26" in found["library.libusb"]["message"]
    assert "libfreenect 0.5" in found["library.libfreenect"]["message"]
    assert found["server.answer"]["status"] == "ok", found["server.answer"]


def test_an_empty_bus_fails_for_want_of_hardware(usb_bus: VirtualBus) -> None:
    with LoopbackServer() as rig:
        status, found, told = check(usb_bus, rig)
    assert (status, told["passed"]) == (1, False)
    assert (found["usb.kinect"]["status"], found["usb.kinect"]["hardware"]) == ("failed", True)
    assert found["usb.kinect"]["see"] == "docs/troubleshooting.md#no-kinect"
    assert found["source.frames"]["skipped"]
    assert found["server.answer"]["status"] == "ok", "the rest is examined all the same"


@pytest.mark.parametrize(
    ("fault", "name", "see"),
    [
        ("deny", "usb.permission", "no-permission"),
        ("busy", "usb.permission", "kinect-in-use"),
        ("stall", "source.frames", "no-frames"),
        ("lose", "source.frames", "torn-frames"),
    ],
)
def test_each_fault_is_told_by_the_check_that_sees_it(
    usb_bus: VirtualBus, fault: str, name: str, see: str
) -> None:
    kinect = usb_bus.add_kinect(SERIAL)
    kinect.write(fault, "1" if fault == "lose" else "")
    with LoopbackServer() as rig:
        _, found, _ = check(usb_bus, rig)
    assert found[name]["status"] in ("failed", "warning"), found[name]
    assert found[name]["see"] == f"docs/troubleshooting.md#{see}"


def test_a_kinect_that_never_answers_ends_the_check_in_time(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect(SERIAL)
    kinect.write("mute")
    with LoopbackServer() as rig:
        _, found, _ = check(usb_bus, rig)
    assert found["source.frames"]["see"] == "docs/troubleshooting.md#hanging-kinect"
    assert found["source.frames"]["hardware"] is True
    assert found["server.answer"]["status"] == "ok"


def test_two_kinects_on_one_controller_are_told(usb_bus: VirtualBus) -> None:
    for _ in range(2):
        usb_bus.add_kinect(SERIAL)
    with LoopbackServer() as rig:
        status, found, _ = check(usb_bus, rig)
    assert status == 1
    assert found["usb.controller"]["status"] == "failed"
