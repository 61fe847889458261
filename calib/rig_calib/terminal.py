"""A calibration as tables for the terminal: what `rig-calib solve` and `rig-server --calibrate` print."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from rich import box, progress
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from rig_calib.evaluation import Evaluation
from rig_calib.figures.tables import camera_rows, edge_rows, key_figures, verdict
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.merged_take import Merge
from rig_calib.pose_graph.solution import Solution
from rig_calib.rig_calibration import RigCalibration
from rig_calib.stages import Progress
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
_SUMMARY_NAMES = {
    "neighbours": "neighbours",
    "used": "used edges",
    "near": "near pairs",
    "absolute": "cameras, aligned",
}
_ERROR_COLUMNS = ("error of", "count", "mean °", "mean mm", "median °", "median mm", "max °", "max mm")
_TEXT_COLUMNS = {"camera", "edge", "why not", "error of", "take"}


@contextmanager
def progress_bar(console: Console) -> Iterator[Progress]:
    """A bar on the console; what it yields is told the stage and the share that is done."""
    columns = (TextColumn("{task.description:<12}"), BarColumn(), TimeElapsedColumn())
    with progress.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("load", total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


def calibration_tables(calibration: RigCalibration, views: Sequence[CameraView]) -> RenderableType:
    """Every camera with its pose and uncertainty, every edge, the key figures, the time, the verdict."""
    viewpoint = rig_viewpoint(calibration.poses, calibration.rig_frame) if calibration.cameras else None
    names = {view.camera_id: view.name for view in views}
    figures = key_figures(calibration, len(views))
    seconds = {f"{stage} s": f"{value:.1f}" for stage, value in calibration.seconds.items()}
    return Group(
        _table(_CAMERA_COLUMNS, camera_rows(calibration, views, viewpoint)),
        *_edges(edge_rows(calibration, names, ())),
        _sentence(figures),
        _sentence(seconds),
        *(Text(f"warning: {warning}", style="yellow") for warning in calibration.warnings),
        Text(verdict(calibration, len(views)), style="bold red" if calibration.failures else "bold green"),
    )


def evaluation_table(evaluation: Evaluation) -> RenderableType:
    """Errors against the truth: of neighbours, used edges and near pairs, and of cameras after alignment."""
    table = _empty_table(_ERROR_COLUMNS)
    shown: list[list[str]] = []
    for name, summary in evaluation.summaries().items():
        errors = (summary.mean, summary.median, summary.max)
        figures = [text for error in errors for text in (f"{error.deg:.3f}", f"{error.mm:.2f}")]
        if figures not in shown:  # in a full ring neighbours, used edges and near pairs are the same
            shown.append(figures)
            table.add_row(_SUMMARY_NAMES.get(name, name), str(summary.count), *figures)
    lines: list[RenderableType] = [table, *_consistency(evaluation)]
    if evaluation.missing:
        lines.append(Text(f"without an estimate: cameras {', '.join(map(str, evaluation.missing))}"))
    return Group(*lines)


def _consistency(evaluation: Evaluation) -> list[RenderableType]:
    """Whether the errors are as large as the calibration's covariances say."""
    told = [
        f"{known.nees:.2f} over {known.count} {name} ({known.low:.2f}–{known.high:.2f} expected)"
        for name, known in evaluation.consistency().items()
    ]
    return [Text(f"consistency: mean NEES per dof {', '.join(told)}")] if told else []


def merge_table(merge: Merge) -> RenderableType:
    """Every take with how well its clock is known on the common one, and what came of them."""
    table = _empty_table(("take", "frames", "σ of its clock µs", "at worst µs"))
    for part in merge.parts:
        figures = (f"{ns / 1e3:.0f}" for ns in (part.typical_uncertainty_ns, part.worst_uncertainty_ns))
        table.add_row(escape(part.path.name), f"{part.frames:,}", *figures)
    torn = [f"{part.path} was not finished: read as far as it goes" for part in merge.parts if part.torn]
    told = f"{merge.frames:,} frames in {merge.sets:,} sets, on the clock {merge.clock}"
    lost = f"; {merge.not_recorded:,} frames had not been recorded" if merge.not_recorded else ""
    return Group(table, Text(told + lost), *(Text(line, style="yellow") for line in torn))


def pose_graph_report(solution: Solution) -> RenderableType:
    """What became of a pose graph: size, objective, certificate, seconds; the edges that were rejected."""
    before, after = (values[solution.objective] for values in (solution.before, solution.after))
    size = f"{len(solution.graph.ids):,} poses, {len(solution.kept):,} edges"
    costs = f"{solution.objective} objective {before:.6g} before, {after:.6g} after"
    lines = [f"{size}: {costs}, {_certificate(solution)}, {solution.seconds:.2f} s"]
    if solution.rejected:
        named = ", ".join(f"{i}–{j}" for i, j in solution.rejected)
        lines.append(f"{len(solution.rejected)} wrong edges left out: {named}")
    return Text("\n".join(lines))


def _certificate(solution: Solution) -> str:
    certificate = solution.certificate
    subject = "" if solution.objective == "chordal" else "its start, the chordal optimum, is "
    if certificate.gap is None:
        return f"{subject}not checked (too large)"
    if certificate.certified:
        return f"{subject}certified global"
    return f"{subject}not certified: gap {certificate.gap:.1%} to the bound {certificate.lower_bound:.6g}"


def _edges(rows: Sequence[Mapping[str, str]]) -> list[RenderableType]:
    """A table of the edges that have support; without a drawing most pairs of a rig have none."""
    bare = [row["pair"] for row in rows if row["inliers"] == "0"]
    table = _table(_EDGE_COLUMNS, [row for row in rows if row["inliers"] != "0"])
    return [table, Text(f"without matches that agree: {', '.join(bare)}")] if bare else [table]


def _table(columns: Mapping[str, str], rows: Sequence[Mapping[str, str]]) -> Table:
    table = _empty_table(columns)
    for row in rows:
        table.add_row(*(escape(row.get(key, "–")) for key in columns.values()))
    return table


def _empty_table(headings: Iterable[str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in headings:
        text = heading in _TEXT_COLUMNS
        table.add_column(heading, justify="left" if text else "right", no_wrap=heading != "why not")
    return table


def _sentence(values: dict[str, str]) -> Text:
    return Text("; ".join(f"{name} {value}" for name, value in values.items()))
