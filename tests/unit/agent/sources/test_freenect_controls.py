"""The operator's words for a Kinect."""

from pathlib import Path
from typing import get_args

import pytest

from rig_agent.sources.base import ControlRefused, ControlValue
from rig_agent.sources.freenect import COUNTERS, FreenectSettings
from rig_agent.sources.freenect_controls import NAMES, RestartStep, Wishes, degrees, on_or_off
from rig_agent.sources.freenect_formats import ColorName
from rig_agent.usb.motor import Led
from rig_protocol.message_bytes import MAX_GAUGES

DOCS = Path(__file__).resolve().parents[4] / "docs"
PLAIN = Wishes("bayer", True, "11bit", True, True, False, False)


@pytest.mark.parametrize(("value", "on"), [(True, True), ("on", True), ("false", False), (False, False)])
def test_on_and_off_may_be_truth_values_or_words(value: ControlValue, on: bool) -> None:
    assert on_or_off("depth", value) is on


@pytest.mark.parametrize("value", [2, 0.5, "", "yes please"])
def test_anything_else_is_neither_on_nor_off(value: ControlValue) -> None:
    with pytest.raises(ControlRefused, match="depth is true or false"):
        on_or_off("depth", value)


def test_a_truth_value_is_no_angle() -> None:
    with pytest.raises(ControlRefused, match="a number of degrees"):
        degrees("tilt_deg", True)


def test_infrared_leaves_the_colour_cameras_automatics_alone() -> None:
    switches = PLAIN.told("color", "ir", "1414").switches("1414")
    assert (switches.auto_exposure, switches.auto_white_balance) == (None, None)


def test_only_a_k4w_is_told_of_near_mode() -> None:
    assert PLAIN.switches("1414").near_mode is None
    assert PLAIN.told("near_mode", True, "K4W").switches("K4W").near_mode is True


def test_the_page_on_control_names_every_control_and_every_value() -> None:
    page = (DOCS / "control.md").read_text()
    values = [*get_args(Led), *get_args(ColorName), *get_args(RestartStep)]
    assert [word for word in (*NAMES, *values) if f"`{word}`" not in page] == []


def test_the_page_on_monitoring_names_every_counter_and_a_heartbeat_has_room_for_them() -> None:
    page = (DOCS / "monitoring.md").read_text()
    assert [name for name in COUNTERS if f"`source_{name}`" not in page] == []
    of_the_agent = 5  # dropped, resent, damaged, source_losses, temperature_c
    assert len(COUNTERS) + of_the_agent <= MAX_GAUGES


def test_settings_and_controls_have_the_same_names() -> None:
    at_start = {"led", "color", "auto_exposure", "auto_white_balance", "mirror", "near_mode"}
    assert at_start <= set(NAMES) & set(FreenectSettings.model_fields)
