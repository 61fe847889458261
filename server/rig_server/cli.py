"""The command line of `rig-server`."""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from rig_protocol.errors import ConfigurationError
from rig_protocol.programs import EXIT_FAILED, run_program, set_up_logging
from rig_server.operator_cli import add_operator_commands

if TYPE_CHECKING:
    from rig_server.config import RigSettings
    from rig_server.rig import Rig

_RING = 12  # cameras where no settings say how many

_EXAMPLES = """
**Examples**

`rig-server init` — write ./rig.toml, every option explained, then list your cameras in it

`rig-server` — receive on UDP port 4012 and show the live table until Ctrl-C

`rig-server --watch calibration/calibration.json` — the same, and an alarm when a camera has moved

`rig-server --record take.mcap` — the same, and everything that comes on the disk

`rig-server --replay take.mcap --calibrate` — calibrate on what was recorded

`rig-server --metrics 9100` — the same, and metrics for a Prometheus on this machine

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
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Settings; else ./rig.toml, else /etc/kinect-rig/rig.toml, if there."
        ),
    ] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Receive here; else 0.0.0.0:4012.")
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Serve metrics to Prometheus; to this machine unless HOST."),
    ] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Calibrate the ring on the first complete sets, then end.")
    ] = False,
    simulate: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, max=64, help="Start N simulated agents on this machine."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="S", min=0, help="Seed of the simulated room and units.")
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(metavar="K", min=1, max=100, help="Panoramic frames to use; else 5."),
    ] = None,
    method: Annotated[
        str | None, typer.Option(metavar="joint|paper", help="How to calibrate; else joint.")
    ] = None,
    target_mm: Annotated[
        float | None,
        typer.Option(metavar="X", help="End once neighbours are expected to be known to X mm (RMS)."),
    ] = None,
    target_deg: Annotated[
        float | None, typer.Option(metavar="X", help="The same for their rotation, in degrees.")
    ] = None,
    coach: Annotated[
        bool,
        typer.Option(
            "--coach", help="Go on with fresh sets until every overlap holds: hang patterns meanwhile."
        ),
    ] = False,
    projector_groups: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, max=3, help="Capture in 2 or 3 turns, no neighbour's projector on; else 1."
        ),
    ] = None,
    recalibrate: Annotated[
        str | None,
        typer.Option(metavar="CAMERA", help="Find only this one (name or id) anew, keep all others."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="What --recalibrate starts from; else DIR/calibration.json."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the results; else ./calibration.")
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="Record what comes, as it comes (docs/recording.md)."),
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Take the frames of a recording, not of agents.")
    ] = None,
    replay_speed: Annotated[
        str | None,
        typer.Option(metavar="live|max|X", help="As fast as recorded, as possible, X times as fast."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin the recording again at its end.")] = False,
    seek: Annotated[
        float | None, typer.Option(metavar="S", min=0, help="Leave out the recording's first S seconds.")
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(metavar="CALIBRATION", help="Say when a camera moves from its place in this file."),
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Take frames of anybody: only on an isolated bench.")
    ] = False,
) -> None:
    """Receive the agents' frames and group them into panoramic frames.

    With `--calibrate`: wait for the cameras, calibrate, write calibration.json, report.html, cloud.ply and
    panorama.png. Meanwhile a table shows how well every overlap is known so far and what to do where it lacks
    support. A target that K sets do not reach ends with status 1 and says which pair limits; the files are
    written. Otherwise: show a live table until Ctrl-C.
    """
    if context.invoked_subcommand is not None:
        return
    _refuse_options_without_effect(
        calibrate,
        simulate,
        {
            "--frames": frames,
            "--method": method,
            "--target-mm": target_mm,
            "--target-deg": target_deg,
            "--coach": coach or None,
            "--projector-groups": projector_groups,
            "--recalibrate": recalibrate,
            "--calibration": calibration,
            "--out": out,
        },
        seed,
        listen,
    )
    _refuse_with_replay(
        replay,
        {"--simulate": simulate, "--listen": listen, "--record": record, "--insecure": insecure or None},
        {"--replay-speed": replay_speed, "--loop": loop or None, "--seek": seek},
    )
    from rig_server.config import WatchSettings, load_rig_settings

    if watch is not None and calibrate:
        raise ConfigurationError("--watch has no effect with --calibrate, which measures all places anew")
    changes = {
        "listen": listen,
        "insecure": insecure or None,
        "metrics": metrics,
        "capture": {
            "frames": frames,
            "target_mm": target_mm,
            "target_deg": target_deg,
            "projector_groups": projector_groups,
        },
        "calibration": {"method": method},
        "watch": {"calibration": watch},
    }
    settings = load_rig_settings(config, changes)
    if calibrate and settings.synchroniser.policy == "latest":
        raise ConfigurationError(
            'synchroniser.policy = "latest" repeats frames, which a calibration must not: use "partial"'
        )
    if calibrate and replay is not None and settings.capture.projector_groups > 1:
        raise ConfigurationError("projector groups need a live rig: a recording's projectors cannot be told")
    if calibrate:  # what is measured anew is not watched over
        settings = settings.model_copy(update={"watch": WatchSettings()})
    origin = _Origin(simulate, seed, record, replay, _speed(replay_speed), loop, seek or 0.0)
    console = Console()
    set_up_logging(settings.log_level, console)
    # What takes a second to import comes after everything that can be refused at once.
    if not calibrate:
        from rig_server.receiving import receive

        with _open_rig(settings, origin) as rig:
            receive(rig, console)
        return
    from rig_calib.outputs import known_calibration, make_output_folder
    from rig_server.calibrating import calibrate_rig
    from rig_server.calibration_task import CalibrationTask

    folder = out or Path("calibration")
    known = known_calibration(recalibrate, calibration, folder)
    make_output_folder(folder)
    with _open_rig(settings, origin) as rig:
        if recalibrate is None or known is None:
            task = CalibrationTask.whole_rig(rig.settings, coach)
        else:
            task = CalibrationTask.one_camera(rig.settings, known, recalibrate, coach)
        calibrate_rig(rig, folder, console, task)


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
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Settings; else ./rig.toml, else /etc/kinect-rig/rig.toml, if there."
        ),
    ] = None,
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


@dataclass(frozen=True, slots=True)
class _Origin:
    """Where the frames come from, as the options say; `speed` None: as fast as possible."""

    simulate: int | None
    seed: int | None
    record: Path | None
    replay: Path | None
    speed: float | None
    loop: bool
    seek_s: float


@contextlib.contextmanager
def _open_rig(settings: "RigSettings", origin: _Origin) -> Iterator["Rig"]:
    """The rig that the options ask for, not begun yet, and its metrics where settings ask for them."""
    from rig_server.announcement import announced
    from rig_server.metrics_endpoint import metrics_served
    from rig_server.operator_requests import OperatorRequests
    from rig_server.operator_socket import operator_served
    from rig_server.rig import Rig

    if origin.replay is not None:
        from rig_server.replay import ReplayOptions

        options = ReplayOptions(origin.speed, origin.loop, origin.seek_s)
        rig = Rig.replayed(origin.replay, settings, options)
    elif origin.simulate is not None:
        rig = Rig.simulated(origin.simulate, origin.seed or 0, settings=settings, record=origin.record)
    else:
        rig = Rig.live(settings, origin.record)
    announces = settings.announce and origin.simulate is None and origin.replay is None
    with (
        contextlib.closing(rig),
        metrics_served(settings.metrics_address, rig.status),
        operator_served(settings.control_socket, OperatorRequests(rig)),
        announced(settings.address) if announces else contextlib.nullcontext(),
    ):
        yield rig


def _refuse_options_without_effect(
    calibrate: bool, simulate: int | None, of_calibrate: dict[str, Any], seed: int | None, listen: str | None
) -> None:
    """ConfigurationError for an option that would have no effect."""
    for option, value in of_calibrate.items():
        if value is not None and not calibrate:
            raise ConfigurationError(f"{option} needs --calibrate")
    if seed is not None and simulate is None:
        raise ConfigurationError("--seed needs --simulate N")
    if listen is not None and simulate is not None:
        raise ConfigurationError("--listen has no effect with --simulate, which uses a free loopback port")


def _refuse_with_replay(replay: Path | None, live: dict[str, Any], of_replay: dict[str, Any]) -> None:
    """ConfigurationError for an option that a recording, or the lack of one, makes pointless."""
    for option, value in (of_replay if replay is None else live).items():
        if value is not None:
            told = "needs --replay FILE" if replay is None else "has no effect with --replay"
            raise ConfigurationError(f"{option} {told}")


def _speed(text: str | None) -> float | None:
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


add_operator_commands(app)


def main() -> None:
    """Entry point."""
    run_program(app)


if __name__ == "__main__":
    main()
