"""Commands of `rig-server` that speak to the running server: control, identify, agents."""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from rig_protocol.errors import ConfigurationError
from rig_protocol.programs import EXIT_FAILED

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", metavar="FILE", help="Settings; else ./rig.toml, else /etc/kinect-rig/rig.toml, if there."
    ),
]
SocketOption = Annotated[
    Path | None,
    typer.Option("--socket", metavar="FILE", help="The server's `control_socket`; else of the settings."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]

_CONTROL_EXAMPLES = """
**Examples**

`rig-server control --list` — what there is to set

`rig-server control cam03 led blink_green` — one camera, by name or slot

`rig-server control all auto_exposure off` — every connected camera

Needs a running rig-server on this machine, and its user or root. docs/control.md explains it.
Exit status: 0 all did it, 1 some did not or no server runs, 2 wrong usage.
"""


def add_operator_commands(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command(epilog=_CONTROL_EXAMPLES)(control)
    app.command()(identify)
    app.command()(agents)


def control(
    camera: Annotated[
        str | None, typer.Argument(metavar="CAMERA|all", help="Name or slot.", show_default=False)
    ] = None,
    name: Annotated[str | None, typer.Argument(help="What to set.", show_default=False)] = None,
    value: Annotated[
        str | None, typer.Argument(help="on, off, a number or a word.", show_default=False)
    ] = None,
    catalogue: Annotated[bool, typer.Option("--list", help="List what there is to set.")] = False,
    config: ConfigOption = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Have cameras of the running rig do something: lamp, tilt, exposure, streams, restart, log level."""
    from rig_server.control_catalogue import parse_value

    if catalogue:
        _print_catalogue()
        return
    if camera is None or name is None:
        raise ConfigurationError("write rig-server control CAMERA|all NAME [VALUE], or --list")
    results = _control(_socket(socket, config), camera, name, parse_value(name, value))
    _tell(results, as_json)


def identify(
    camera: Annotated[str, typer.Argument(metavar="CAMERA|all", help="Name or slot.")],
    seconds: Annotated[float, typer.Option(min=0, max=3600, help="How long.")] = 10.0,
    config: ConfigOption = None,
    socket: SocketOption = None,
) -> None:
    """Have a Kinect's lamp blink red and yellow for some seconds: which one is it?"""
    from rig_server.control_catalogue import IDENTIFYING, ORDINARY

    place = _socket(socket, config)
    try:
        _tell(_control(place, camera, "led", IDENTIFYING), as_json=False)
        time.sleep(seconds)
    finally:  # also after Ctrl-C
        _tell(_control(place, camera, "led", ORDINARY), as_json=False)


def agents(config: ConfigOption = None, socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """List the cameras of the running rig."""
    from rig_server.operator_socket import ask_server

    answer = ask_server(_socket(socket, config), {"do": "agents"})
    if as_json:
        typer.echo(json.dumps({key: answer[key] for key in answer if key != "error"}, indent=2))
        return
    table = _table("slot", "name", "serial", "port", "")
    for one in answer["cameras"]:
        state = f"{one['fps']:.1f} fps" if one["connected"] else "away"
        table.add_row(str(one["camera"]), one["name"], one["serial"] or "–", one["port_path"] or "–", state)
    Console(highlight=False).print(table)


def _control(place: Path | None, camera: str, name: str, value: object) -> list[dict[str, Any]]:
    from rig_server.operator_socket import ask_server

    request = {"do": "control", "camera": camera, "name": name, "value": value}
    results: list[dict[str, Any]] = ask_server(place, request)["results"]
    return results


def _tell(results: list[dict[str, Any]], as_json: bool) -> None:
    """Print what became of it; exit status 1 where not all did it."""
    if as_json:
        typer.echo(json.dumps({"results": results}, indent=2))
    for one in [] if as_json else results:
        typer.echo(f"{one['name']}: {'' if one['outcome'] == 'done' else one['outcome'] + ': '}{one['text']}")
    if not results:
        typer.echo("no camera is connected", err=True)
    if not results or any(one["outcome"] != "done" for one in results):
        raise typer.Exit(EXIT_FAILED)


def _print_catalogue() -> None:
    from rig_server.control_catalogue import CATALOGUE

    table = _table("name", "values", "what it sets")
    for entry in CATALOGUE:
        table.add_row(entry.name, entry.values or "–", entry.meaning)
    Console(highlight=False).print(table)
    typer.echo("An agent says which of these its camera has when it is asked for one that it has not.")


def _table(*headings: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in headings:
        table.add_column(heading)
    return table


def _socket(given: Path | None, config: Path | None) -> Path | None:
    from rig_server.config import load_rig_settings

    return given or load_rig_settings(config).control_socket
