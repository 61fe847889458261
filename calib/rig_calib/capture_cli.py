"""Commands of `rig-calib` that take a capture frame by frame: fuse, export."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:  # heavy: imported where they are used, so that --help is quick
    from collections.abc import Mapping

    from rich.console import Console

    from rig_calib.fusion.gains import Gain
    from rig_calib.offline.capture import Capture
    from rig_calib.rig_calibration import RigCalibration

Folder = Annotated[
    Path, typer.Argument(help="Rig folder (nominal.json, one subfolder a camera), or a recording FILE.mcap.")
]
Out = Annotated[Path, typer.Option(help="Folder for the results.")]
Frames = Annotated[
    int | None,
    typer.Option(min=1, max=100, help="Panoramic frames to use; else all (at most 100), 5 of a take."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
Calibration = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="The calibration.json of the rig; else the one a recording carries."),
]
WorkerCount = Annotated[
    int | None, typer.Option("--workers", min=1, max=256, help="Processes of this machine; else one a core.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Work on the Dask cluster there instead, as tcp://10.0.0.1:8786."),
]

_EXPORT_EXAMPLES = """
**Examples**

`rig-calib export results/calibration.json --format ros2 --out rig.launch.py` — the calibration, for a program

`rig-calib export take.mcap --format foxglove --out view.mcap` — images, cloud and transforms, for Foxglove

`rig-calib export take.mcap --format rig-folder --out rig --frames 5` — a rig folder, for `rig-calib solve`

`rig-calib export take.mcap --format ply --out clouds --workers 4` — four processes of this machine

`rig-calib export /nfs/take.mcap --format ply --out /nfs/clouds --scheduler tcp://10.0.0.1:8786` — a cluster
"""


def fuse(
    folder: Folder,
    out: Out,
    calibration: Calibration = None,
    frames: Frames = None,
    mesh: Annotated[bool, typer.Option("--mesh", help="Write mesh.ply and mesh.glb, too.")] = False,
    voxel_mm: Annotated[float, typer.Option(min=2, max=100, help="Of the mesh: how fine it is.")] = 10.0,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="Of the mesh: processes of this machine; else one a core."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Of the mesh: work on the Dask cluster there instead."),
    ] = None,
) -> None:
    """Fuse a rig folder or a recording with a calibration into cloud.ply and panorama.png."""
    from rich.console import Console

    from rig_calib.offline.capture import open_capture
    from rig_calib.outputs import make_output_folder, write_fused
    from rig_calib.recorded_calibration import calibration_for
    from rig_calib.rig_folder_calibration import read_description, read_panoramas
    from rig_calib.tsdf.mesh_files import require_libraries
    from rig_calib.view import views_from_panoramas

    if mesh:
        require_libraries()
    known = calibration_for(folder, calibration)
    description = read_description(folder)
    panoramas = list(read_panoramas(folder, description, frames))
    make_output_folder(out)
    fused = write_fused(out, known, views_from_panoramas(description, panoramas))
    console = Console(highlight=False)
    console.print(f"{len(fused.cloud):,} points in {out / 'cloud.ply'}")
    for why in fused.cloud.skipped:
        console.print(why, style="yellow")
    if mesh:
        capture = open_capture(folder).only(one.index for one in panoramas)
        _fuse_mesh(console, capture, known, fused.gains, out, voxel_mm * 1e-3, (workers, scheduler))


def _fuse_mesh(
    console: "Console",
    capture: "Capture",
    known: "RigCalibration",
    gains: "Mapping[int, Gain]",
    out: Path,
    voxel_m: float,
    workers: tuple[int | None, str | None],
) -> None:
    from rig_calib.offline.workers import open_workers
    from rig_calib.outputs import MESH_GLB, MESH_PLY, write_mesh
    from rig_calib.terminal import progress_bar
    from rig_calib.tsdf.fusing import fuse_capture

    with progress_bar(console) as tell, open_workers(*workers) as hands:
        volume = fuse_capture(capture, known, gains, voxel_m, hands, lambda share: tell("mesh", share))
    made = write_mesh(out, volume, known)
    rims, length_m = made.holes()
    console.print(
        f"{len(made.faces):,} triangles, {made.area_m2():.1f} m², in {out / MESH_PLY} and {MESH_GLB}; "
        f"{rims} rims, {length_m:.0f} m together, where nothing was measured any more"
    )


def export(
    source: Annotated[
        Path, typer.Argument(help="A calibration.json; or frames: a rig folder, or a recording FILE.mcap.")
    ],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="kalibr, ros2, urdf, colmap, nerfstudio, opencv; of frames foxglove, rerun, tum, rig-folder "
            "and others. See docs/exports.md.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="File to write, or a folder, as the format has it.")],
    rig: Annotated[
        Path | None,
        typer.Option(
            help="Of a calibration, where intrinsics stand: the rig folder (with its images), nominal.json "
            "or rig.toml."
        ),
    ] = None,
    calibration: Calibration = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Panoramic frames: of a calibration those of --rig to list (1), of frames how many (all).",
        ),
    ] = None,
    first: Annotated[int, typer.Option(min=0, help="Of frames: leave out so many at the beginning.")] = 0,
    every: Annotated[int, typer.Option(min=1, help="Of frames: one in so many.")] = 1,
    fps: Annotated[float, typer.Option(min=0.1, max=240, help="Of a video: frames a second.")] = 30.0,
    centre: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Of panoramas: seen from there, metres in the rig frame."),
    ] = None,
    match_colors: Annotated[
        bool, typer.Option("--match-colors", help="Make cameras of different exposure agree.")
    ] = False,
    workers: WorkerCount = None,
    scheduler: Scheduler = None,
) -> None:
    """Write a calibration, or the frames of a capture, for another program (docs/exports.md)."""
    from rich.console import Console

    from rig_calib.frame_exports.formats import FORMATS

    of_frames = {
        "--calibration": calibration,
        "--first": first,
        "--every": every > 1,
        "--centre": centre,
        "--match-colors": match_colors,
        "--workers": workers,
        "--scheduler": scheduler,
    }
    _refuse_other_kind(form, source, {"--rig": rig} if form in FORMATS else of_frames)
    console = Console(highlight=False, soft_wrap=True)
    if form in FORMATS:
        _export_frames(
            console,
            form,
            source,
            out,
            calibration,
            slice(first, None if frames is None else first + frames * every, every),
            fps,
            (centre, match_colors),
            (workers, scheduler),
        )
    else:
        _export_calibration(console, form, source, out, rig, frames or 1)


def _refuse_other_kind(form: str, source: Path, pointless: "Mapping[str, object]") -> None:
    """ConfigurationError for an unknown format, a source that is none of it, and `pointless` options."""
    from rig_calib.exports.formats import FORMATS as CALIBRATION_FORMATS
    from rig_calib.frame_exports.formats import FORMATS
    from rig_protocol.errors import ConfigurationError

    if form not in (*CALIBRATION_FORMATS, *FORMATS):
        known = ", ".join((*CALIBRATION_FORMATS, *FORMATS))
        raise ConfigurationError(f"format {form!r} is none of {known}")
    wanted = "frames: a rig folder, or a recording FILE.mcap" if form in FORMATS else "a calibration.json"
    if (form in FORMATS) == (source.suffix == ".json"):
        raise ConfigurationError(f"{source}: format {form} is of {wanted}")
    for option, value in pointless.items():
        if value:
            raise ConfigurationError(f"{option} has no effect: format {form} is of {wanted}")


def _export_calibration(
    console: "Console", form: str, path: Path, out: Path, rig: Path | None, frames: int
) -> None:
    from rig_calib.exports.exported_rig import exported_rig
    from rig_calib.exports.formats import find_format, target_folder, write_export
    from rig_calib.exports.known_rig import KnownRig, read_known_rig
    from rig_calib.rig_calibration import RigCalibration

    chosen, result = find_format(form), RigCalibration.load(path)
    known = KnownRig() if rig is None else read_known_rig(rig, frames)
    exported = exported_rig(
        result, known.models, known.images, known.image_root_from(target_folder(chosen, out))
    )
    made = chosen.export(exported)
    for written in write_export(chosen, made, out):
        console.print(str(written), markup=False)
    failed = [f"this calibration did not pass its gate: {why}" for why in result.failures]
    for note in [*failed, *known.left_out(result.poses), *made.notes]:
        console.print(note, style="yellow", markup=False)


def _export_frames(
    console: "Console",
    form: str,
    path: Path,
    out: Path,
    calibration: Path | None,
    chosen: slice,
    fps: float,
    look: tuple[str | None, bool],
    hands: tuple[int | None, str | None],
) -> None:
    from rig_calib.frame_exports.formats import FORMATS
    from rig_calib.frame_exports.job import ExportJob, FusionLook
    from rig_calib.offline.capture import open_capture
    from rig_calib.offline.workers import open_workers
    from rig_calib.rig_calibration import RigCalibration
    from rig_calib.terminal import progress_bar
    from rig_protocol.errors import ConfigurationError

    chosen_format = FORMATS[form]
    exporter, capture = chosen_format.exporter(), open_capture(path)
    positions = range(*chosen.indices(len(capture.marks)))
    if not positions:
        raise ConfigurationError(f"{path} holds {len(capture.marks)} panoramic frames: none is left")
    chosen_format.check(out, len(positions))
    known = capture.calibration if calibration is None else RigCalibration.load(calibration)
    seen = FusionLook(_centre_m(look[0]), look[1])
    with progress_bar(console) as tell, open_workers(*hands) as workers:
        job = ExportJob(capture, positions, out, workers, known, fps, seen, lambda share: tell(form, share))
        exported = exporter(job)
    for written in exported.paths:
        console.print(str(written), markup=False)
    for note in exported.notes:
        console.print(note, style="yellow", markup=False)


def _centre_m(text: str | None) -> tuple[float, float, float] | None:
    """ConfigurationError for what are not three numbers."""
    from rig_protocol.errors import ConfigurationError

    if text is None:
        return None
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigurationError(f"--centre {text}: write three numbers in metres, as 0,0,1.2") from None
    return x, y, z


def add_capture_commands(app: typer.Typer) -> None:
    """Add them to the program."""
    app.command()(fuse)
    app.command(epilog=_EXPORT_EXAMPLES)(export)
