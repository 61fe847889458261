"""What the drift watch found, in sentences, as a table and as plain numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rig_calib.drift.watch import CameraDrift, DriftStatus
from rig_calib.rig_calibration import RigCalibration

_STYLES = {"moved": "bold red", "in place": "green"}


def camera_names(calibration: RigCalibration) -> dict[int, str]:
    """Names by camera id."""
    return {camera.id: camera.name for camera in calibration.cameras}


def moved_message(drift: CameraDrift, names: Mapping[int, str]) -> str:
    """Which camera moved, by how much, and what to do."""
    name = names.get(drift.camera, str(drift.camera))
    message = (
        f"{name} has moved by {_amount(drift)}, going by {drift.found_by}: put it back and check again, or "
        f"run `rig-server --calibrate --recalibrate {drift.camera}`"
    )
    if not drift.rivals:
        return message
    rivals = " or ".join(names.get(k, str(k)) for k in drift.rivals)
    return f"{message} (it may as well be {rivals}: only an overlap of both tells of it)"


def unknown_message(unknown: Sequence[int], names: Mapping[int, str]) -> str:
    """Of which cameras nothing is known, and what to do."""
    listed = ", ".join(names.get(k, str(k)) for k in unknown)
    return (
        f"nothing tells where {listed} is: its overlaps show too little "
        "that both cameras recognise and have depth of; check that the calibration is of this rig, show it "
        "something with texture, or give frames from right after the calibration (--reference)"
    )


def drift_table(status: DriftStatus, names: Mapping[int, str]) -> RenderableType:
    """A line a camera, and the residuals of the overlaps."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("camera", "state", "by", "going by"):
        table.add_column(column, no_wrap=True)
    for drift in status.cameras:
        amount = _amount(drift) if drift.state == "moved" else ""
        table.add_row(
            names.get(drift.camera, str(drift.camera)),
            Text(drift.state, _STYLES.get(drift.state, "yellow")),
            amount,
            drift.found_by or "",
        )
    residuals = [
        f"{names.get(pair.i, pair.i)}–{names.get(pair.j, pair.j)} "
        + ("–" if pair.mm is None or pair.deg is None else f"{pair.mm:.1f} mm {pair.deg:.2f}°")
        for pair in status.pairs
    ]
    lines = [f"what two cameras see of one place lies apart by: {', '.join(residuals)}"] if residuals else []
    lines.append(
        f"{status.looks} panoramic frames looked at; the rig as a whole moved {status.rig_mm:.1f} mm"
    )
    return Group(table, *map(Text, lines))


def status_dict(status: DriftStatus, names: Mapping[int, str]) -> dict[str, Any]:
    """Plain numbers, for JSON."""
    return {
        "moved": [camera.camera for camera in status.moved],
        "cameras": [{"name": names.get(camera.camera), **asdict(camera)} for camera in status.cameras],
        "pairs": [asdict(pair) for pair in status.pairs],
        "rig_mm": status.rig_mm,
        "frames": status.looks,
    }


def _amount(drift: CameraDrift) -> str:
    return f"{drift.deg:.2f}° ± {drift.sigma_deg:.2f}° and {drift.mm:.1f} ± {drift.sigma_mm:.1f} mm"
