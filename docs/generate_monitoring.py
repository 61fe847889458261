"""Write the table of metrics in docs/monitoring.md from the code: `make docs`."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from rig_calib.drift.watch import CameraDrift, DriftStatus, PairDrift
from rig_protocol.clock_sync import ClockEstimate
from rig_protocol.counters import CameraCounters
from rig_protocol.recorder import RecordingStatus
from rig_server.durations import Durations
from rig_server.exposition import families
from rig_server.metrics import CameraMetrics, DriftReport, RigStatus

PAGE = Path(__file__).parent / "monitoring.md"

_BEGIN, _END = "<!-- made by `make docs` -->\n", "<!-- until here -->\n"
_MAX_VALUES = 8  # of a label, that fit the table


def page(text: str) -> str:
    """The page `text` with the present table."""
    before, _, rest = text.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    rows = ["| metric | type | labels | what it tells |", "|---|---|---|---|", *_rows()]
    return before + _BEGIN + "\n".join(rows) + "\n" + _END + after


def _rows() -> Iterator[str]:
    for metric in families(_every_metric()):
        name = f"{metric.name}_total" if metric.type == "counter" else metric.name
        values: dict[str, list[str]] = {}
        for sample in metric.samples:
            for label, value in sample.labels.items():
                if label != "le" and value not in values.setdefault(label, []):
                    values[label].append(value)
        labels = "; ".join(_label(*item) for item in values.items())
        yield f"| `{name}` | {metric.type} | {labels} | {metric.documentation} |"


def _label(name: str, values: list[str]) -> str:
    """Its values, too, where they are the same for every rig."""
    if name in ("camera", "other", "event", "gauge") or values == [""]:
        return f"`{name}`"
    return f"`{name}`: {', '.join(values[:_MAX_VALUES])}"


def _every_metric() -> RigStatus:
    """A status that has each of them."""
    camera = CameraMetrics(
        0,
        "cam00",
        connected=True,
        temperature_c=50.0,
        counters=asdict(CameraCounters()) | {"": 0},
        dropped=dict.fromkeys(("late", "undecodable", "not_decoded_in_time"), 0),
        gauges={"dropped": 0.0},
        clock=ClockEstimate(0, 0.0, 0, 0, 1),
    )
    return RigStatus(
        (camera,),
        rejected={"": 0},
        drift=DriftReport(
            DriftStatus((CameraDrift(0, "in place"),), (PairDrift(0, 1, 0.0, 0.0),)), {0: "cam00", 1: "cam01"}
        ),
        recording=RecordingStatus(Path("take.mcap")),
        queues=dict.fromkeys(("decoder", "synchroniser", "sets"), 0),
        durations=Durations().snapshot(),
    )


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
