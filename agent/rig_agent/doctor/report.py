"""The findings as the operator reads them and as a script does."""

import json
import textwrap
from collections.abc import Iterable, Sequence
from importlib.metadata import version

from rich.console import Console
from rich.text import Text

from rig_agent.doctor.finding import Finding, Status
from rig_protocol.troubleshooting import reference

_STYLES = {Status.OK: "green", Status.WARNING: "yellow", Status.FAILED: "bold red", Status.SKIPPED: "dim"}
_MOST_COLUMNS = 80
_STATUS_COLUMNS = max(map(len, Status)) + 2


def passed(findings: Iterable[Finding]) -> bool:
    """True when nothing failed; warnings do not count."""
    return all(finding.status != Status.FAILED for finding in findings)


def print_finding(console: Console, finding: Finding) -> None:
    """One finding: wrapped to 80 columns on a terminal, one line into a pipe; commands never break."""
    indent = " " * _STATUS_COLUMNS
    text = f"{finding.check}: {finding.text}"
    if console.is_terminal:
        columns = min(console.width, _MOST_COLUMNS) - _STATUS_COLUMNS
        text = f"\n{indent}".join(textwrap.wrap(text, max(columns, 20), break_on_hyphens=False))
    status = Text(finding.status.ljust(_STATUS_COLUMNS), _STYLES[finding.status])
    console.print(status + Text(text), soft_wrap=True)
    if finding.mend is not None:
        console.print(Text(f"{indent}-> {finding.mend}", "bold"), soft_wrap=True)
    if finding.topic is not None:
        console.print(Text(f"{indent}{reference(finding.topic)}", "dim"), soft_wrap=True)


def summary(findings: Sequence[Finding]) -> str:
    """The last line."""
    counts = {status: sum(finding.status == status for finding in findings) for status in Status}
    hardware = sum(finding.hardware for finding in findings if finding.status == Status.FAILED)
    of_it = f" ({hardware} for want of hardware)" if hardware else ""
    return (
        f"{counts[Status.FAILED]} failed{of_it}, {counts[Status.WARNING]} warnings, "
        f"{counts[Status.OK]} ok, {counts[Status.SKIPPED]} skipped"
    )


def to_json(findings: Sequence[Finding], source: str) -> str:
    """The keys are stable; docs/check.md explains them."""
    failures = [finding for finding in findings if finding.status == Status.FAILED]
    report = {
        "software": f"kinect-rig {version('kinect-rig')}",
        "source": source,
        "passed": passed(findings),
        "passed_but_for_hardware": all(finding.hardware for finding in failures),
        "checks": [finding.to_dict() for finding in findings],
    }
    return json.dumps(report, indent=2, ensure_ascii=False)
