"""Fixtures of the integration tests."""

from pathlib import Path

import pytest

from support.virtual_usb import virtual_bus


@pytest.fixture
def usb_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> virtual_bus.VirtualBus:
    """An empty virtual USB bus, in place of this machine's for as long as the test lasts."""
    bus = virtual_bus.VirtualBus(tmp_path / "usb")
    virtual_bus.enter(bus, monkeypatch)
    return bus
