"""Commands of `rig-server` that speak to the running server: control, identify, agents, assign."""

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
from rig_server.options import ConfigOption

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

_ASSIGN_EXAMPLES = """
**Examples**

`rig-server agents` — who is here, and who waits for a slot

`rig-server assign pi-7 3` — the Kinect of the waiting agent pi-7 is camera 3 from now on

`rig-server assign A00366A10921051A 3 --offline` — the same by its serial number, with no server running

Writes rig.toml (its comments stay) and tells the running server. docs/control.md explains it.
Exit status: 0 done, 2 wrong usage or settings.
"""


def add_operator_commands(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command(epilog=_CONTROL_EXAMPLES)(control)
    app.command()(identify)
    app.command()(agents)
    app.command(epilog=_ASSIGN_EXAMPLES)(assign)


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
    console = Console(highlight=False)
    console.print(table)
    for one in answer["unassigned"]:
        traits = ", ".join(f"{key} {one[key]}" for key in ("serial", "port_path") if one[key])
        wish = "" if one["camera_id"] is None else f", says it is slot {one['camera_id']}"
        console.print(
            f"without a slot: {one['name']} at {one['host']} ({traits or 'no serial number'}{wish}): "
            f"rig-server assign {one['serial'] or one['name']} SLOT",
            soft_wrap=True,
        )


def assign(
    agent: Annotated[str, typer.Argument(help="Name or serial number of a waiting agent, or of a camera.")],
    slot: Annotated[int, typer.Argument(min=0, max=63, help="Slot in the ring.")],
    name: Annotated[str | None, typer.Option(help="Name for tables and files; else camNN.")] = None,
    offline: Annotated[
        bool, typer.Option("--offline", help="AGENT is a serial number; only write the file.")
    ] = False,
    config: ConfigOption = None,
    socket: SocketOption = None,
) -> None:
    """Give a slot to a camera: in rig.toml, and in the running server at once."""
    from rig_server.config import settings_file
    from rig_server.operator_socket import ask_server
    from rig_server.rig_toml import assign_slot

    file = config or settings_file()
    if file is None:
        raise ConfigurationError("there is no rig.toml to write the slot into: rig-server init makes one")
    place = _socket(socket, config)
    found = {"serial": agent, "port_path": None}
    if not offline:
        found = _identity(agent, ask_server(place, {"do": "agents"}))
    told = assign_slot(file, slot, found["serial"], found["port_path"], name)
    if not offline:
        ask_server(place, {"do": "assign", "slot": slot, "name": name, **found})
    who = f"serial {found['serial']}" if found["serial"] else f"port {found['port_path']}"
    typer.echo("; ".join([f"{file}: slot {slot} is for {who}", *told]))


def _identity(agent: str, known: dict[str, Any]) -> dict[str, str | None]:
    """By what the server knows a camera again; ConfigurationError: it is not here, or has no such thing."""
    here = [*known["unassigned"], *known["cameras"]]
    matching = [one for one in here if agent in (one["name"], one["serial"])]
    if len({(one["serial"], one.get("host")) for one in matching}) > 1:
        raise ConfigurationError(f"several agents are called {agent}: give the serial number")
    if not matching:
        names = ", ".join(one["serial"] or one["name"] for one in here) or "nobody"
        raise ConfigurationError(f"no agent {agent} is here, only {names}; --offline takes a serial number")
    one = matching[0]
    if one["serial"] and one["serial"].strip("0"):
        return {"serial": one["serial"], "port_path": None}
    alike = [other for other in here if other["port_path"] == one["port_path"]]
    if one["port_path"] and len(alike) == 1:
        return {"serial": None, "port_path": one["port_path"]}
    raise ConfigurationError(
        f"the Kinect of {agent} has no serial number, and others are at the same port of their machine: "
        "set `camera` to the slot in that machine's agent.toml instead"
    )


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
