"""Rules of the programs' exit codes."""

import subprocess
import sys

import pytest

PROGRAM = """
import signal, typer
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.programs import leave_done, run_program
app = typer.Typer()
@app.command()
def work(outcome: str) -> None:
    errors = {"failed": RigError("camera 3 is [not] there"), "usage": ConfigurationError("no such key"),
              "torn": DataError("a file is torn"), "stopped": KeyboardInterrupt()}
    if outcome in errors:
        raise errors[outcome]
    if outcome == "terminated":
        signal.raise_signal(signal.SIGTERM)
"""
TOOL, SERVICE = PROGRAM + "run_program(app)", PROGRAM + "run_program(app, on_sigterm=leave_done)"


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["done"], 0, ""),
        (["failed"], 1, "camera 3 is [not] there"),
        (["torn"], 1, "a file is torn"),
        (["usage"], 2, "no such key"),
        (["--nonsense"], 2, "No such option"),
        (["stopped"], 130, ""),
        (["terminated"], 130, ""),
    ],
)
def test_the_exit_status_tells_the_kind_of_failure(arguments: list[str], status: int, message: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", TOOL, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == status
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_sigterm_is_the_ordinary_end_of_a_service() -> None:
    done = subprocess.run([sys.executable, "-c", SERVICE, "terminated"], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("outcome", "entry"),
    [("failed", "other-failures"), ("usage", "wrong-settings"), ("torn", "damaged-files")],
)
def test_an_error_ends_with_where_to_read_on(outcome: str, entry: str) -> None:
    done = subprocess.run([sys.executable, "-c", TOOL, outcome], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1] == f"see docs/troubleshooting.md#{entry}"


def test_a_line_of_the_log_names_its_entry_and_one_without_stays_as_it_is() -> None:
    code = (
        "import logging; from rig_protocol.programs import set_up_logging; set_up_logging(); "
        "from rig_protocol.troubleshooting import Topic, see; "
        "logging.warning('no light', extra=see(Topic.POWER)); logging.warning('dark')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines() == [
        "WARNING root: no light (see docs/troubleshooting.md#power)",
        "WARNING root: dark",
    ]
