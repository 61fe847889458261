"""The command line of `rig-server`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from rig_protocol.errors import ConfigurationError
from rig_protocol.programs import EXIT_FAILED, run_program, set_up_logging
from rig_server.operator_cli import add_operator_commands
from rig_server.option_rules import (
    parsed_speed,
    refuse_with_replay,
    refuse_without_calibrate,
    refuse_without_simulate,
    run_settings,
)
from rig_server.options import (
    CalibrateOption,
    CalibrationOption,
    CoachOption,
    ConfigOption,
    ConsoleOption,
    FramesOption,
    InsecureOption,
    ListenOption,
    LoopOption,
    MethodOption,
    MetricsOption,
    OutOption,
    ProjectorGroupsOption,
    RecalibrateOption,
    RecordOption,
    ReplayOption,
    ReplaySpeedOption,
    SeedOption,
    SeekOption,
    SimulateOption,
    TargetDegOption,
    TargetMmOption,
    WatchOption,
)

if TYPE_CHECKING:
    from rig_server.config import RigSettings
    from rig_server.opening import Origin

_RING = 12  # cameras where no settings say how many

_EXAMPLES = """
**Examples**

`rig-server init` — write ./rig.toml, every option explained, then list your cameras in it

`rig-server` — receive on UDP port 4012 and show the live table until Ctrl-C

`rig-server --watch calibration/calibration.json` — the same, and an alarm when a camera has moved

`rig-server --record take.mcap` — the same, and everything that comes on the disk

`rig-server --replay take.mcap --calibrate` — calibrate on what was recorded

`rig-server --replay take.mcap --seek 60 --record part.mcap` — cut a part out of it

`rig-server --metrics 9100` — the same, and metrics for a Prometheus on this machine

`rig-server --console 8080` — the same, and the console for a browser on this machine

`rig-server --calibrate --out calibration` — calibrate the ring that streams to this PC

`rig-server --calibrate --simulate 12 --out demo` — the same with twelve simulated Kinects on this machine

`rig-server --calibrate --coach --target-mm 3` — the same, until it is that good: hang patterns meanwhile

`rig-server --calibrate --projector-groups 2` — the same, no neighbour's projector on at the same time

`rig-server --calibrate --recalibrate cam04` — one camera was knocked: find it, keep all others

`rig-server control cam03 depth off` — have one camera of the running rig do something (`--list`: what)

`rig-server budget` — what the network must carry, what fits, and what the server would choose

Every option can also stand in rig.toml or in the environment (RIG_SERVER_LISTEN, ...).
The command line wins over the environment, the environment over the file.
Exit status: 0 done, 1 it failed (the message says what to do), 2 wrong usage or settings.
"""

app = typer.Typer(
    add_completion=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True, epilog=_EXAMPLES)
def run(
    context: typer.Context,
    config: ConfigOption = None,
    listen: ListenOption = None,
    metrics: MetricsOption = None,
    console: ConsoleOption = None,
    calibrate: CalibrateOption = False,
    simulate: SimulateOption = None,
    seed: SeedOption = None,
    frames: FramesOption = None,
    method: MethodOption = None,
    target_mm: TargetMmOption = None,
    target_deg: TargetDegOption = None,
    coach: CoachOption = False,
    projector_groups: ProjectorGroupsOption = None,
    recalibrate: RecalibrateOption = None,
    calibration: CalibrationOption = None,
    out: OutOption = None,
    record: RecordOption = None,
    replay: ReplayOption = None,
    replay_speed: ReplaySpeedOption = None,
    loop: LoopOption = False,
    seek: SeekOption = None,
    watch: WatchOption = None,
    insecure: InsecureOption = False,
) -> None:
    """Receive the agents' frames and group them into panoramic frames.

    With `--calibrate`: wait for the cameras, calibrate, write calibration.json, report.html, cloud.ply and
    panorama.png. Meanwhile a table shows how well every overlap is known so far and what to do where it lacks
    support. A target that K sets do not reach ends with status 1 and says which pair limits; the files are
    written. Otherwise: show a live table until Ctrl-C.
    """
    if context.invoked_subcommand is not None:
        return
    of_calibrate = {
        "--frames": frames,
        "--method": method,
        "--target-mm": target_mm,
        "--target-deg": target_deg,
        "--coach": coach or None,
        "--projector-groups": projector_groups,
        "--recalibrate": recalibrate,
        "--calibration": calibration,
        "--out": out,
    }
    of_live = {"--simulate": simulate, "--listen": listen, "--insecure": insecure or None}
    of_replay = {"--replay-speed": replay_speed, "--loop": loop or None, "--seek": seek}
    refuse_without_calibrate(calibrate, of_calibrate)
    refuse_without_simulate(simulate, seed, listen)
    refuse_with_replay(replay, of_live, of_replay)
    if watch is not None and calibrate:
        raise ConfigurationError("--watch has no effect with --calibrate, which measures all places anew")
    capture = {
        "frames": frames,
        "target_mm": target_mm,
        "target_deg": target_deg,
        "projector_groups": projector_groups,
    }
    changes = {
        "listen": listen,
        "insecure": insecure or None,
        "metrics": metrics,
        "console": {"listen": console},
        "capture": capture,
        "calibration": {"method": method},
        "watch": {"calibration": watch},
    }
    settings = run_settings(config, changes, calibrate, replay is not None)
    terminal = Console()
    set_up_logging(settings.log_level, terminal)
    # What takes a second to import comes after everything that can be refused at once.
    from rig_server.opening import Origin

    origin = Origin(simulate, seed, record, replay, parsed_speed(replay_speed), loop, seek or 0.0)
    if calibrate:
        _calibrate(settings, origin, terminal, out or Path("calibration"), recalibrate, calibration, coach)
    else:
        _receive(settings, origin, terminal)


@app.command()
def recover(
    take: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording's first file.")],
) -> None:
    """Mend a recording that was torn by a crash or damaged; what was there is kept as FILE.torn.

    Leaves out what cannot be read. Exit status: 0 it is sound now, 1 it could not be written, 2 no such file.
    """
    from rig_protocol.recording import recover as recover_take

    mended = recover_take(take)
    for part in mended:
        typer.echo(f"mended {part}; what was there is now {part.name}.torn")
    if not mended:
        typer.echo(f"{take} is sound")


@app.command()
def init(
    path: Annotated[Path, typer.Option(help="File to write.", metavar="FILE")] = Path("rig.toml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> None:
    """Write a commented rig.toml that changes nothing yet."""
    from rig_protocol.settings_docs import write_commented_toml
    from rig_server.config import RigSettings

    write_commented_toml(RigSettings, path, force)
    Console().print(f"wrote {path}; list the cameras in it, then run rig-server", soft_wrap=True)


@app.command()
def keygen(
    path: Annotated[Path, typer.Option(help="File to write.", metavar="FILE")] = Path("rig.key"),
    force: Annotated[bool, typer.Option("--force", help="Replace a key: locks out who has it.")] = False,
) -> None:
    """Make the rig's key: who holds it may join and watch.

    Copy the file to the PC's and every Pi's /etc/kinect-rig/rig.key (or name it by `key_file`), readable by
    the service's user alone (mode 0600).
    """
    import secrets

    from rig_protocol.key_file import write_key
    from rig_protocol.rig_key import RigKey

    write_key(path, RigKey.generate(secrets.token_bytes), force)
    Console().print(
        f"wrote {path} (mode 0600); copy it to /etc/kinect-rig/rig.key of the PC and of every Pi, "
        f"for example: scp {path} pi@cam00.local:",
        soft_wrap=True,
    )


_BUDGET_EXAMPLES = """
**Examples**

`rig-server budget` — the rig of rig.toml, or twelve cameras, at 30 frames/s

`rig-server budget --cameras 12 --link-mbit 100` — what a 100-Mbit port would do to it

`rig-server budget --fps 15 --json` — for a script

A frame's size follows from the scene: the table goes by real frames, and says how many frames a second
scenes of pure noise would allow. docs/network.md explains it, `[link]` of rig.toml sets it.
Exit status: 0 something fits, 1 nothing does, 2 wrong usage or settings.
"""


@app.command(epilog=_BUDGET_EXAMPLES)
def budget(
    config: ConfigOption = None,
    cameras: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=64, help="Cameras; else those of rig.toml, else 12.")
    ] = None,
    fps: Annotated[
        float, typer.Option(metavar="F", min=0.1, max=240, help="Frames a second of each camera.")
    ] = 30.0,
    link_mbit: Annotated[
        float | None, typer.Option(metavar="M", help="Speed of this PC's port in Mbit/s; else 1000.")
    ] = None,
    mtu: Annotated[
        int | None, typer.Option(metavar="BYTES", help="Largest IP packet of the network; else 1500.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")] = False,
) -> None:
    """Print what the network must carry, what fits, and what the server would choose and why."""
    from rig_server.budget_report import make_report, render
    from rig_server.config import load_rig_settings

    settings = load_rig_settings(config, {"link": {"speed_mbit": link_mbit, "mtu": mtu}})
    known = len(settings.cameras) or settings.expected_cameras or _RING
    report = make_report(settings.link, cameras or known, fps)
    if as_json:
        typer.echo(json.dumps(report.to_dict(), indent=2))
    else:
        Console(highlight=False).print(render(report))
    if report.chosen_fps is None:
        raise typer.Exit(EXIT_FAILED)


def _receive(settings: "RigSettings", origin: "Origin", terminal: Console) -> None:
    from rig_server.opening import open_rig
    from rig_server.receiving import receive

    with open_rig(settings, origin, terminal) as rig:
        receive(rig, terminal)


def _calibrate(
    settings: "RigSettings",
    origin: "Origin",
    terminal: Console,
    folder: Path,
    recalibrate: str | None,
    calibration: Path | None,
    coach: bool,
) -> None:
    from rig_calib.outputs import known_calibration, make_output_folder
    from rig_server.calibrating import calibrate_rig
    from rig_server.calibration_task import CalibrationTask
    from rig_server.capture_log import CaptureLog
    from rig_server.opening import open_rig

    known = known_calibration(recalibrate, calibration, folder)
    make_output_folder(folder)
    log = CaptureLog(settings.capture.frames)
    with open_rig(settings, origin, terminal, log) as rig:
        if recalibrate is None or known is None:
            task = CalibrationTask.whole_rig(rig.settings, coach)
        else:
            task = CalibrationTask.one_camera(rig.settings, known, recalibrate, coach)
        calibrate_rig(rig, folder, terminal, task, log)


add_operator_commands(app)


def main() -> None:
    """Entry point."""
    run_program(app)


if __name__ == "__main__":
    main()
