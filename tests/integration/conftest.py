"""Fixtures of the integration tests."""

from pathlib import Path

import pytest

from support.openni_driver import virtual_devices
from support.virtual_usb import virtual_bus


@pytest.fixture
def usb_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> virtual_bus.VirtualBus:
    """An empty virtual USB bus, in place of this machine's for as long as the test lasts."""
    bus = virtual_bus.VirtualBus(tmp_path / "usb")
    virtual_bus.enter(bus, monkeypatch)
    return bus


@pytest.fixture
def openni_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> virtual_devices.VirtualDevices:
    """A folder of virtual OpenNI2 devices, empty, for as long as the test lasts."""
    devices = virtual_devices.VirtualDevices(tmp_path / "openni")
    for name, value in devices.variables.items():
        monkeypatch.setenv(name, value)
    return devices
