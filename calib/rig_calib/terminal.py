"""A calibration as tables for the terminal: what `rig-calib solve` and `rig-server --calibrate` print."""

from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from rig_calib.figures.tables import camera_rows, edge_rows, key_figures, verdict
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView

_CAMERA_COLUMNS = {
    "camera": "name",
    "position mm": "position",
    "azimuth °": "azimuth",
    "elev. °": "elevation",
    "roll °": "roll",
    "σ °": "sigma_deg",
    "σ mm": "sigma_mm",
    "depth": "depth_scale",
}
_EDGE_COLUMNS = {
    "edge": "pair",
    "matches": "matches",
    "inliers": "inliers",
    "rms mm": "rms_mm",
    "used": "used",
    "why not": "reason",
}
_TEXT_COLUMNS = {"camera", "edge", "why not"}


def calibration_tables(calibration: RigCalibration, views: Sequence[CameraView]) -> RenderableType:
    """Every camera with its pose and uncertainty, every edge, the key figures, the time, the verdict."""
    viewpoint = rig_viewpoint(calibration.poses, calibration.rig_frame) if calibration.cameras else None
    names = {view.camera_id: view.name for view in views}
    figures = key_figures(calibration, len(views))
    seconds = {f"{stage} s": f"{value:.1f}" for stage, value in calibration.seconds.items()}
    return Group(
        _table(_CAMERA_COLUMNS, camera_rows(calibration, views, viewpoint)),
        _table(_EDGE_COLUMNS, edge_rows(calibration, names, ())),
        _sentence(figures),
        _sentence(seconds),
        *(Text(f"warning: {warning}", style="yellow") for warning in calibration.warnings),
        Text(verdict(calibration, len(views)), style="bold red" if calibration.failures else "bold green"),
    )


def _table(columns: dict[str, str], rows: Sequence[dict[str, str]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in columns:
        text = heading in _TEXT_COLUMNS
        table.add_column(heading, justify="left" if text else "right", no_wrap=heading != "why not")
    for row in rows:
        table.add_row(*(escape(row.get(key, "–")) for key in columns.values()))
    return table


def _sentence(values: dict[str, str]) -> Text:
    return Text("; ".join(f"{name} {value}" for name, value in values.items()))
