"""The program `rig-calib`: calibrates a rig folder, compares, fuses, measures intrinsics, prints, exports."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig_calib.capture_cli import AsJson, Folder, Frames, Out, add_capture_commands
from rig_protocol.programs import run_program, set_up_logging
from rig_protocol.troubleshooting import Topic

if TYPE_CHECKING:  # heavy: imported where they are used, so that --help is quick
    from rig_calib.rig_calibration import RigCalibration

_EXAMPLES = """
**Examples**

`rig-calib solve captures/office --out results` — calibrate a rig folder, write calibration, report, cloud

`rig-calib solve captures/now --recalibrate cam04 --out results` — one camera moved: find it, keep the others

`rig-calib evaluate results/calibration.json captures/office/truth.json` — errors against known poses

`rig-calib fuse captures/hall --calibration results/calibration.json --out hall` — fuse another capture

`rig-calib fuse take.mcap --calibration results/calibration.json --out hall --mesh` — a surface, too

`rig-calib pose-graph map.g2o --out solved.g2o --robust` — optimise any graph of 3D poses

`rig-calib check results/calibration.json captures/today` — has a camera moved since then?

`rig-calib intrinsics board/*.png --board 9x6 --square-mm 25 --out unit.json` — measure one colour camera

`rig-calib merge cam*.mcap --out take.mcap` — what each Pi recorded by itself, as one take

`rig-calib pattern --out patterns` — sheets to print and to hang where neighbours' views overlap

`rig-calib export results/calibration.json --format ros2 --out rig.launch.py` — for other programs
"""

app = typer.Typer(
    add_completion=False,
    rich_markup_mode="markdown",
    no_args_is_help=True,
    epilog=_EXAMPLES,
    help="Calibrate a ring of RGB-D cameras from what they see, and fuse it.",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command()
def solve(
    folder: Folder,
    out: Out,
    method: Annotated[
        str | None, typer.Option(metavar="joint|paper", help="Default: joint. paper: as in the publication.")
    ] = None,
    frames: Frames = None,
    seed: Annotated[int | None, typer.Option(help="Of every random choice.")] = None,
    recalibrate: Annotated[
        str | None,
        typer.Option(metavar="CAMERA", help="Find this one (name or id) anew, keep all others as they are."),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --recalibrate; default: that of --out.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate a rig folder; exit 1 when the result fails its quality gate, with the files still written.

    With `--recalibrate` a calibration.json that is overwritten stays as calibration-before.json.
    """
    from rich.console import Console

    from rig_calib.outputs import keep_before, known_calibration, make_output_folder, write_outputs
    from rig_calib.rig_folder_calibration import recalibrate_folder, solve_folder
    from rig_calib.settings import CalibrationSettings
    from rig_calib.terminal import calibration_tables, progress_bar
    from rig_protocol.errors import RigError
    from rig_protocol.settings import load_settings

    set_up_logging("WARNING")
    settings = load_settings(CalibrationSettings, None, "RIG_CALIB_", {"method": method, "seed": seed})
    known = known_calibration(recalibrate, calibration, out)
    make_output_folder(out)
    console = Console(quiet=as_json, highlight=False)
    with progress_bar(console) as tell:
        if recalibrate is None or known is None:
            result, views = solve_folder(folder, settings, frames, tell)
        else:
            result, views = recalibrate_folder(folder, known, recalibrate, settings, frames, tell)
            keep_before(out)
        write_outputs(out, result.calibration, views, result.evidence, result.poses_before, tell)
    console.print(calibration_tables(result.calibration, views))
    if as_json:
        _print_json(result.calibration.to_dict())
    if result.calibration.failures:
        raise RigError(
            "the calibration fails its gate: " + "; ".join(result.calibration.failures),
            Topic.CALIBRATION_REFUSED,
        )


@app.command()
def evaluate(
    calibration: Annotated[Path, typer.Argument(help="A calibration.json.")],
    truth: Annotated[Path, typer.Argument(help="A truth.json, or the folder that holds it.")],
    as_json: AsJson = False,
) -> None:
    """Errors of a calibration against known poses: of pairs, and of cameras after aligning both rigs."""
    from rich.console import Console

    from rig_calib.evaluation import evaluate as compare
    from rig_calib.terminal import evaluation_table
    from rig_protocol.rig_folder import read_true_poses

    evaluation = compare(_load(calibration), read_true_poses(truth))
    if as_json:
        _print_json(evaluation.to_dict())
    else:
        Console(highlight=False).print(evaluation_table(evaluation))


@app.command()
def check(
    calibration: Annotated[Path, typer.Argument(help="The calibration.json of this rig.")],
    folder: Annotated[Path, typer.Argument(help="Rig folder or recording of now; no patterns are needed.")],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="The same of right after calibrating, from the same place: shows far smaller motions.",
        ),
    ] = None,
    frames: Frames = None,
    as_json: AsJson = False,
) -> None:
    """Say which cameras have moved since the calibration, and by how much; exit 0 when all are in place."""
    from rich.console import Console

    from rig_calib.drift.rig_watch import check as compare
    from rig_calib.drift.words import camera_names, drift_table, moved_message, status_dict, unknown_message
    from rig_calib.rig_folder_calibration import read_description, read_panoramas
    from rig_protocol.errors import RigError

    set_up_logging("WARNING")
    known, description = _load(calibration), read_description(folder)
    before = () if reference is None else read_panoramas(reference, read_description(reference))
    result = compare(known, description, read_panoramas(folder, description, frames), before)
    names = camera_names(known)
    if as_json:
        _print_json({**status_dict(result.status, names), "unknown": result.unknown})
    else:
        Console(highlight=False).print(drift_table(result.status, names))
    told = [moved_message(camera, names) for camera in result.status.moved]
    if result.unknown:
        told.append(unknown_message(result.unknown, names))
    if told:
        raise RigError("; ".join(told), Topic.CAMERA_MOVED)


@app.command()
def merge(
    takes: Annotated[list[Path], typer.Argument(help="Takes of agents or servers: their first files.")],
    out: Annotated[Path, typer.Option(metavar="FILE.mcap", help="The take to write.")],
    max_spread_ms: Annotated[
        float | None, typer.Option(min=0.001, help="Widest exposure spread of a set; else a frame period.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Put the takes of several machines on one clock and into one take, which everything else plays."""
    from rich.console import Console

    from rig_calib.merged_take import merge_takes
    from rig_calib.terminal import merge_table, progress_bar

    set_up_logging("WARNING")
    console = Console(quiet=as_json, highlight=False)
    with progress_bar(console) as tell:
        merged = merge_takes(takes, out, max_spread_ms, tell)
    console.print(merge_table(merged))
    if as_json:
        _print_json(merged.to_dict())


@app.command()
def intrinsics(
    images: Annotated[list[Path], typer.Argument(help="Colour images of a checkerboard, ten or more.")],
    board: Annotated[str, typer.Option(metavar="CxR", help="Inner corners across and down, as 9x6.")],
    square_mm: Annotated[float, typer.Option(help="Width of one square, measured on the print.")],
    out: Annotated[Path, typer.Option(help="Intrinsics file to write.")],
    infrared: Annotated[
        list[Path] | None, typer.Option(help="Infrared image of the same board; once for each colour image.")
    ] = None,
) -> None:
    """Measure one unit's intrinsics with a checkerboard: libfreenect knows no colour focal length."""
    from rich.console import Console

    from rig_calib.checkerboard import Board
    from rig_calib.intrinsics import run

    estimate = run(images, Board.parse(board, square_mm), out, infrared or ())
    color = estimate.color.intrinsics
    Console(highlight=False).print(
        f"fx {color.fx:.2f} fy {color.fy:.2f} cx {color.cx:.2f} cy {color.cy:.2f} px, "
        f"rms {estimate.color.rms_px:.3f} px, written to {out}"
    )


@app.command("pose-graph")
def pose_graph(
    graph: Annotated[Path, typer.Argument(help="A .g2o file: VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX.")],
    out: Annotated[Path, typer.Option(help="The .g2o file to write.")],
    robust: Annotated[
        bool, typer.Option("--robust", help="Find wrong edges, leave them out and name them.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Optimise a pose graph and say whether its optimum is the global one.

    Minimised is SE-Sync's chordal objective, sum κ |R_j − R_i R_ij|² + τ |t_j − t_i − R_i t_ij|² with
    κ = 3 / (2 tr Λ_R⁻¹), τ = 3 / tr Λ_t⁻¹: plain least squares whose optimum can be certified. Where the
    information of an edge differs much by direction (one axis ten times another, strong correlation), it is
    ½ sum r' Λ r, r = Log(T_ij⁻¹ T_i⁻¹ T_j), with the full 6×6 information, from the chordal optimum on.
    """
    from rich.console import Console

    from rig_calib.pose_graph.g2o import read_g2o, write_g2o
    from rig_calib.pose_graph.solution import solve as solve_graph
    from rig_calib.terminal import pose_graph_report, progress_bar
    from rig_protocol.errors import ConfigurationError

    if out.is_dir() or not out.parent.is_dir():
        raise ConfigurationError(f"{out} cannot be written: --out names a file in a folder that exists")
    console = Console(quiet=as_json, highlight=False)
    with progress_bar(console) as tell:
        solution = solve_graph(read_g2o(graph), robust, tell=tell)
        write_g2o(out, solution.graph)
    console.print(pose_graph_report(solution))
    if as_json:
        _print_json(solution.to_dict())


@app.command()
def pattern(
    out: Annotated[Path, typer.Option(help="Folder for patterns.pdf and patterns.json.")] = Path("patterns"),
    paper: Annotated[str, typer.Option(metavar="A4|A3|A2|A1|A0", help="Paper to print on.")] = "A3",
    patterns: Annotated[
        int | None,
        typer.Option(min=1, help="Different patterns; default: 4 (A4), 3 (A3), 2 or 1 (larger) an overlap."),
    ] = None,
    cameras: Annotated[int, typer.Option(min=2, max=64, help="Cameras of the ring.")] = 12,
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Another seed makes another set: never hang one twice.")
    ] = 1,
    tiles: Annotated[
        str | None, typer.Option(metavar="CxR", help="Sheets of one pattern across and down, as 3x4.")
    ] = None,
    size_m: Annotated[
        str | None, typer.Option(metavar="WxH", help="Or the size of one pattern in metres, as 0.9x1.2.")
    ] = None,
) -> None:
    """Make calibration patterns to print: a set for a room of twelve cameras by default, 36 sheets of A3."""
    from rich.console import Console

    from rig_calib.outputs import make_output_folder
    from rig_calib.pattern_layout import plan_patterns
    from rig_calib.pattern_sheets import write_pattern_set
    from rig_calib.terminal import progress_bar

    plan = plan_patterns(paper, seed, cameras, patterns, tiles, size_m)
    make_output_folder(out)
    console = Console(highlight=False)
    with progress_bar(console) as tell:
        sheets, record = write_pattern_set(out, plan, lambda share: tell("patterns", share))
    megabytes = sheets.stat().st_size / 1e6
    console.print(f"{plan.summary}: {sheets} ({megabytes:.1f} MB), {record}", soft_wrap=True, markup=False)
    console.print(
        "Next: print at 100 % on matt paper, measure the scale bar (100 mm), hang the sheets where "
        "neighbours' views overlap (page 1 shows how), then `rig-server --calibrate`.",
        soft_wrap=True,
    )


add_capture_commands(app)


def main() -> None:
    """Entry point of `rig-calib`."""
    run_program(app)


def _load(path: Path) -> "RigCalibration":
    from rig_calib.rig_calibration import RigCalibration

    return RigCalibration.load(path)


def _print_json(values: dict[str, Any]) -> None:
    typer.echo(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
