"""Where benchmarks leave their figures: build/bench.json and marked sections of pages under docs/."""

import json
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
RESULTS = REPOSITORY / "build" / "bench.json"
PERFORMANCE = REPOSITORY / "docs" / "performance.md"

_TITLE = "# Performance\n\nEvery figure was printed by the command that stands beside it.\n"


def merge_results(sections: Mapping[str, Any]) -> None:
    """Put sections into build/bench.json with the commit and the machine; other sections stay."""
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results |= {"commit": _commit(), "machine": machine(), **sections}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


def results_of(section: str) -> Any:
    """What build/bench.json holds of a section; None when that is nothing."""
    return json.loads(RESULTS.read_text()).get(section) if RESULTS.exists() else None


def write_section(name: str, text: str, target: Path = PERFORMANCE) -> None:
    """Replace what stands between the markers `name:begin` and `name:end` of a page (docs/performance.md)."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    page = target.read_text() if target.exists() else _TITLE
    if begin not in page:
        page += f"\n{begin}\n{end}\n"
    before, rest = page.split(begin, 1)
    _, after = rest.split(end, 1)
    target.write_text(f"{before}{begin}\n{text.strip()}\n{end}{after}")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def machine(*libraries: str) -> str:
    """Processor, Python, and the versions of these libraries."""
    information = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*: (.*)", information.read_text()) if information.exists() else []
    processor = f"{len(models)} × {models[0]}" if models else platform.processor() or platform.machine()
    versions = [f"{library} {version(library)}" for library in libraries]
    return ", ".join([processor, f"Python {platform.python_version()}", *versions])


def _commit() -> str:
    """The commit of the working tree, marked when it has changes."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=12"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    return described.stdout.strip() or "unknown"
