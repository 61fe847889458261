"""`rig-server budget`: what each way to send images asks of the link, and which the server would choose."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec_by_name
from rig_protocol.messages import Hello
from rig_server.config import LinkSettings
from rig_server.link_budget import Pacing, Port, ceiling_fps, frame_cost
from rig_server.stream_planner import Refusal, StreamPlanner
from rig_server.stream_sizes import expected_bytes, paper_bytes, worst_bytes

_PIXELS = 640 * 480
_AWAY = ("192.0.2.1", 0)  # an address for examples: not of this machine
_COLOR = ("bayer-lossless", "bayer-uncompressed", "bgr-jpeg")
_DEPTH = ("disparity-lossless", "disparity-uncompressed")
_WAYS = {
    "raw Bayer + 16-bit": ("bayer-uncompressed", "disparity-uncompressed"),
    "lossless Bayer + depth": ("bayer-lossless", "disparity-lossless"),
    "JPEG + lossless depth": ("bgr-jpeg", "disparity-lossless"),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One way to send images. `share`: of the port; ceilings: fps at which the port is full.

    `worst_ceiling_fps` is for a scene of nothing but noise. `fits`: within the usable share, with the margin
    that is planned with until frames have come.
    """

    name: str
    frame_bytes: int
    mb_s: float
    share: float
    ceiling_fps: float
    worst_ceiling_fps: float
    fits: bool
    chosen: bool


@dataclass(frozen=True, slots=True)
class BudgetReport:
    """The table and the server's choice. `fps`: what is wanted; `chosen_fps`: None when nothing fits."""

    link: LinkSettings
    cameras: int
    fps: float
    rows: tuple[Row, ...]
    reason: str
    chosen_fps: float | None
    pacing: Pacing | None

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "link": self.link.model_dump(),
            "link_mb_s": round(_port(self.link).udp_bytes_s / 1e6, 3),
            "cameras": self.cameras,
            "fps": self.fps,
            "configurations": [asdict(row) for row in self.rows],
            "chosen_fps": self.chosen_fps,
            "reason": self.reason,
            "pacing": None if self.pacing is None else asdict(self.pacing),
        }


def make_report(link: LinkSettings, cameras: int, fps: float) -> BudgetReport:
    """What a server with these settings decides when so many cameras join, before a frame has come."""
    planner = StreamPlanner(link, cameras)
    answer = planner.camera_joined(0, _hello(fps), _AWAY, 0)
    if isinstance(answer, Refusal):
        rows = tuple(_rows(link, cameras, fps, None))
        return BudgetReport(link, cameras, fps, rows, answer.text, None, None)
    chosen = (answer.color_codec, answer.depth_codec)
    rows = tuple(_rows(link, cameras, fps, chosen))
    reason = planner.take_notes()[-1].text
    return BudgetReport(link, cameras, fps, rows, reason, answer.fps, planner.pacing)


def render(report: BudgetReport) -> RenderableType:
    """The report for a terminal; fits 80 columns."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("a frame holds", no_wrap=True)
    headings = ("bytes", "MB/s", "share", "≤ fps", "noise", "")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in report.rows:
        table.add_row(*_cells(row, report), style="bold" if row.chosen else "")
    title = (
        f"{report.cameras} cameras at {report.fps:g} fps, a port of {report.link.speed_mbit:g} Mbit/s "
        f"that carries {_port(report.link).udp_bytes_s / 1e6:.1f} MB/s"
    )
    return Group(Text(title), table, Text(f"{report.reason}."), *map(Text, _pacing_lines(report)))


def _rows(
    link: LinkSettings, cameras: int, fps: float, chosen: tuple[int | None, int | None] | None
) -> Iterator[Row]:
    size = paper_bytes()
    yield _row("RGB24 + 16-bit (paper)", size, size, size, link, cameras, fps, chosen=False)
    for name, (color_name, depth_name) in _WAYS.items():
        ids = (codec_by_name(color_name).id, codec_by_name(depth_name).id)
        expected = sum(expected_bytes(one, _PIXELS) for one in ids)
        worst = sum(worst_bytes(one, _PIXELS) for one in ids)
        planned = min(worst, link.size_margin * expected)
        yield _row(name, expected, planned, worst, link, cameras, fps, chosen=ids == chosen)


def _row(
    name: str,
    expected: float,
    planned: float,
    worst: float,
    link: LinkSettings,
    cameras: int,
    fps: float,
    *,
    chosen: bool,
) -> Row:
    port, agent = _port(link), Port(link.agent_speed_mbit, link.mtu)
    fits_port = fps <= link.usable * ceiling_fps(planned, cameras, port)
    fits_agent = fps <= link.usable * ceiling_fps(planned, 1, agent)
    ceiling = ceiling_fps(expected, cameras, port)
    return Row(
        name,
        frame_bytes=round(expected),
        mb_s=round(cameras * fps * frame_cost(expected, link.mtu).udp_bytes / 1e6, 3),
        share=round(fps / ceiling, 4),
        ceiling_fps=round(ceiling, 2),
        worst_ceiling_fps=round(ceiling_fps(worst, cameras, port), 2),
        fits=fits_port and fits_agent,
        chosen=chosen,
    )


def _cells(row: Row, report: BudgetReport) -> tuple[str, ...]:
    verdict = "fits" if row.fits else "no"
    if row.chosen:
        verdict = f"chosen, {report.chosen_fps:.3g} fps"
    return (
        row.name,
        f"{row.frame_bytes:,}",
        f"{row.mb_s:.1f}",
        f"{row.share:.0%}",
        f"{row.ceiling_fps:.1f}",
        f"{row.worst_ceiling_fps:.1f}",
        verdict,
    )


def _pacing_lines(report: BudgetReport) -> Iterator[str]:
    pacing, link = report.pacing, report.link
    yield "≤ fps: at which the port is full; noise: the same for a scene of nothing but noise."
    yield (
        f"Sizes are those of our real test frames; until yours have come, {link.size_margin:.2f} times as "
        f"much is expected. {link.usable:.0%} of a port may be used."
    )
    if pacing is None:
        return
    backlog, room = pacing.backlog_bytes / 1024, link.switch_buffer_kib
    verdict = "fits" if backlog <= room else "does not fit, so the slots must hold,"
    yield (
        f"Pacing: {pacing.burst} datagrams every {pacing.step_ns / 1e6:.2f} ms from each agent, a slot each, "
        f"over {pacing.spread:.0%} of the frame interval. Should all bursts meet, the switch must hold "
        f"{backlog:.0f} KiB: {verdict} its {room} KiB."
    )


def _hello(fps: float) -> Hello:
    """An agent with default settings and a Kinect."""
    return Hello(
        name="cam00",
        camera_id=0,
        serial=None,
        port_path=None,
        model=CameraModel(),
        color_codecs=tuple(codec_by_name(name).id for name in _COLOR),
        depth_codecs=tuple(codec_by_name(name).id for name in _DEPTH),
        fps=fps,
        software="",
    )


def _port(link: LinkSettings) -> Port:
    return Port(link.speed_mbit, link.mtu)
