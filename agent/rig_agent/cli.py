"""The program `rig-agent`: streams one camera to the rig server."""

import logging
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig_protocol.errors import ConfigurationError
from rig_protocol.programs import EXIT_FAILED, leave_done, run_program, set_up_logging

if TYPE_CHECKING:  # heavy: imported where they are used, so that --help is quick
    from rig_agent.config import AgentSettings
    from rig_protocol.rig_key import RigKey

_log = logging.getLogger(__name__)

_EXAMPLES = """
**Examples**

`rig-agent --server 10.0.0.1` — a Kinect on this Pi, to a server there

`rig-agent --source openni2 --recording office.oni --camera 2` — play an OpenNI2 recording

`rig-agent --source folder --path recordings/office --camera 3` — play camera 3 of a rig folder

`rig-agent --source recording --path take.mcap --camera 3` — play camera 3 of a recorded take

`rig-agent --source synthetic --camera 0 --seed 7` — one camera of the simulated ring

`rig-agent --record /var/lib/kinect-rig/takes --camera 3` — record on this Pi, and stream

`rig-agent --record take.mcap --camera 3 --server none` — only record, without any network

`rig-agent still board-01.png` — one image for the calibration of a lens

`rig-agent --check` — what keeps this machine from streaming, and what mends it

`rig-agent init` — write ./agent.toml, every option explained, then edit it and run `rig-agent`

Every option can also stand in agent.toml or in the environment (RIG_AGENT_SERVER,
RIG_AGENT_FOLDER__PATH, ...). The command line wins over the environment, the environment over the file.
"""

_PLAYED = ("folder", "recording")  # the sources that play a --path

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
        typer.Option(help="Settings file; else ./agent.toml, else /etc/kinect-rig/agent.toml, if there."),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="freenect (a Kinect), openni2 (another camera), folder, recording, synthetic (simulated).",
        ),
    ] = None,
    server: Annotated[
        str | None,
        typer.Option(metavar="HOST[:PORT]", help="Where rig-server listens; none: only --record."),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(metavar="ID", help="Slot in the ring; with a folder or recording, an id or name of it."),
    ] = None,
    path: Annotated[
        Path | None, typer.Option(help="What to play: a rig folder (source folder), a take (recording).")
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The .oni recording to play (source openni2).")
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="Record every frame here; a folder: a new file in it."),
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the simulated rig (source synthetic).")] = None,
    cameras: Annotated[
        int | None, typer.Option(metavar="N", help="Cameras of the simulated ring (source synthetic).")
    ] = None,
    truth_out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the true poses of the simulated ring (source synthetic)."),
    ] = None,
    key_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The rig's key (rig-server keygen makes it).")
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Anybody may listen and join: only on an isolated bench.")
    ] = False,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the effective settings as TOML and exit.")
    ] = False,
    check: Annotated[
        bool,
        typer.Option("--check", help="Look at Kinect, machine, network and server, say what mends, exit."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --check: JSON and nothing else.")] = False,
) -> None:
    """Stream one camera, colour and depth, to the rig server until stopped.

    The agent keeps running when the server restarts, the network fails or the Kinect is unplugged.
    """
    if context.invoked_subcommand is not None:
        return
    _on_signals(leave_done)  # until the agent runs there is nothing to end in order
    from rig_agent.config import load_agent_settings
    from rig_protocol.settings_docs import effective_toml

    slot, name = _slot_or_name(camera)
    overrides: dict[str, Any] = {
        "server": server,
        "source": source,
        "camera": slot,
        "fps": fps,
        "record": {"path": record},
        "key_file": key_file,
        "insecure": insecure or None,
        "openni2": {"recording": recording},
        "synthetic": {"seed": seed, "cameras": cameras},
    }
    settings = load_agent_settings(config, overrides)
    if settings.source in _PLAYED:
        played = {settings.source: {"path": path, "camera": name}}
        settings = load_agent_settings(config, overrides | played)
    _refuse_options_of_another_source(
        settings.source,
        {
            "openni2": {"--recording": recording},
            "folder": {} if settings.source in _PLAYED else {"--path": path, "--camera NAME": name},
            "synthetic": {"--seed": seed, "--cameras": cameras, "--truth-out": truth_out},
        },
    )
    if print_config:
        typer.echo(effective_toml(settings), nl=False)
        return
    if check:
        _check(settings, as_json)
        return
    if as_json:
        raise ConfigurationError("--json belongs to --check")
    set_up_logging(settings.log_level)
    if truth_out is not None:
        _write_truth(truth_out, settings)
    _stream(settings)


@app.command()
def init(
    path: Annotated[Path, typer.Option(help="Where to write.")] = Path("agent.toml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> None:
    """Write a commented agent.toml: every option with its meaning and default."""
    from rig_agent.config import AgentSettings
    from rig_protocol.settings_docs import write_commented_toml

    write_commented_toml(AgentSettings, path, force)
    typer.echo(f"Wrote {path}. Edit it, then run: rig-agent --config {path}")


@app.command()
def still(
    path: Annotated[Path, typer.Argument(help="PNG file to write.")],
    infrared: Annotated[
        bool, typer.Option("--infrared", help="The depth camera's image instead of the colour camera's.")
    ] = False,
    high: Annotated[bool, typer.Option("--high", help="1280×1024 pixels instead of 640×480.")] = False,
    serial: Annotated[
        str | None, typer.Option(metavar="NUMBER", help="Which Kinect, where there are several.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Settings file, as of rig-agent itself.")] = None,
) -> None:
    """Save one image of this machine's Kinect, for `rig-calib intrinsics`; the agent must not be running."""
    import cv2

    from rig_agent.config import load_agent_settings
    from rig_agent.sources.freenect_still import take_still

    if path.suffix.lower() != ".png":
        raise ConfigurationError(f"{path} would lose what the sensor saw: give a name that ends in .png")
    settings = load_agent_settings(config, {"freenect": {"serial": serial}})
    set_up_logging(settings.log_level)
    image = take_still(settings.freenect, "ir" if infrared else "color", high)
    try:
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written: {error.strerror}") from error
    typer.echo(f"Wrote {path}: {image.shape[1]}×{image.shape[0]} pixels")


def main() -> None:
    """Entry point of the program."""
    run_program(app, on_sigterm=leave_done)


def _stream(settings: "AgentSettings") -> None:
    from rig_agent.agent import Agent
    from rig_agent.sources import open_source
    from rig_protocol.codecs import keep_freed_memory

    keep_freed_memory()
    agent = Agent(settings, _key(settings), lambda: open_source(settings))

    def stop(*_: object) -> None:
        _on_signals(signal.SIG_DFL)  # a second Ctrl-C ends the program without ceremony
        agent.stop()

    _on_signals(stop)
    agent.run()
    if agent.restarts:  # the same process to systemd, or whoever watches over it
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606  # our own command line


def _key(settings: "AgentSettings") -> "RigKey | None":
    """The rig's key; None where there is no server: nobody named one, and without a key none would listen."""
    from rig_agent.config import AUTO, NOBODY
    from rig_protocol.key_file import has_key, rig_key

    if settings.server == NOBODY:
        return None
    keyless = not settings.insecure and not has_key(settings.key_file)
    if keyless and settings.server == AUTO and settings.record.path is not None:
        _log.info("there is no rig key here: recording without a server")
        return None
    return rig_key(settings.key_file, settings.insecure)


def _check(settings: "AgentSettings", as_json: bool) -> None:
    """Print the doctor's findings; exit status 1 when one of them is `failed`."""
    from rich.console import Console

    from rig_agent.doctor.examination import examine
    from rig_agent.doctor.machine import Machine
    from rig_agent.doctor.report import passed, print_finding, summary, to_json

    set_up_logging("CRITICAL")  # what the drivers would log is in the findings
    console, findings = Console(highlight=False), []
    for finding in examine(Machine(), settings):
        findings.append(finding)
        if not as_json:
            print_finding(console, finding)
    typer.echo(to_json(findings, settings.source) if as_json else summary(findings))
    if not passed(findings):
        raise typer.Exit(EXIT_FAILED)


def _on_signals(action: Any) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, action)


def _write_truth(path: Path, settings: "AgentSettings") -> None:
    from rig_agent.simulator.ring import true_poses
    from rig_protocol.rig_folder import write_true_poses

    try:
        write_true_poses(path, true_poses(settings.synthetic))
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written: {error.strerror}") from error


def _slot_or_name(camera: str | None) -> tuple[int | None, str | None]:
    """`--camera` as the slot that it is, or as the name that a rig folder knows."""
    if camera is not None and camera.isdecimal():
        return int(camera), None
    return None, camera


def _refuse_options_of_another_source(source: str, owned: dict[str, dict[str, Any]]) -> None:
    """ConfigurationError for an option that the chosen source would silently ignore."""
    for owner, options in owned.items():
        for option, value in options.items():
            if value is not None and source != owner:
                raise ConfigurationError(f"{option} belongs to --source {owner}, but the source is {source}")


if __name__ == "__main__":
    main()
