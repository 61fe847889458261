"""Which options of `rig-server` go together, and the settings that follow from them."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig_protocol.errors import ConfigurationError

if TYPE_CHECKING:
    from rig_server.config import RigSettings


def refuse_without_calibrate(calibrate: bool, of_calibrate: Mapping[str, Any]) -> None:
    """ConfigurationError for an option that has an effect with `--calibrate` only."""
    for option, value in of_calibrate.items():
        if value is not None and not calibrate:
            raise ConfigurationError(f"{option} needs --calibrate")


def refuse_without_simulate(simulate: int | None, seed: int | None, listen: str | None) -> None:
    """ConfigurationError for an option that simulated cameras, or the lack of them, make pointless."""
    if seed is not None and simulate is None:
        raise ConfigurationError("--seed needs --simulate N")
    if listen is not None and simulate is not None:
        raise ConfigurationError("--listen has no effect with --simulate, which uses a free loopback port")


def refuse_with_replay(replay: Path | None, live: Mapping[str, Any], of_replay: Mapping[str, Any]) -> None:
    """ConfigurationError for an option that a recording, or the lack of one, makes pointless."""
    for option, value in (of_replay if replay is None else live).items():
        if value is not None:
            told = "needs --replay FILE" if replay is None else "has no effect with --replay"
            raise ConfigurationError(f"{option} {told}")


def parsed_speed(text: str | None) -> float | None:
    """Times the speed of the recording; None for as fast as possible."""
    if text == "max":
        return None
    try:
        speed = 1.0 if text in (None, "live") else float(text or "")
    except ValueError:
        speed = 0.0
    if not 0.01 <= speed <= 1000:
        raise ConfigurationError(f"--replay-speed {text}: write live, max, or a number from 0.01 to 1000")
    return speed


def run_settings(
    config: Path | None, changes: Mapping[str, Any], calibrate: bool, replays: bool
) -> "RigSettings":
    """The settings, changed by the options; ConfigurationError for what a calibration cannot go by."""
    from rig_server.config import WatchSettings, load_rig_settings

    settings = load_rig_settings(config, changes)
    if not calibrate:
        return settings
    if settings.synchroniser.policy == "latest":
        raise ConfigurationError(
            'synchroniser.policy = "latest" repeats frames, which a calibration must not: use "partial"'
        )
    if replays and settings.capture.projector_groups > 1:
        raise ConfigurationError("projector groups need a live rig: a recording's projectors cannot be told")
    return settings.model_copy(update={"watch": WatchSettings()})  # what is measured anew is not watched over
