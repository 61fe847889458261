"""The section Transport of docs/performance.md and its pictures, from the sections of bench.json."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from support.benchmark_record import machine, markdown_table
from support.pictures import picture

FIRST_VERSION = Path(__file__).with_name("transport_first_version.json")
_INCOMPLETE_BAR, _ADDED_BAR_MS = 0.1, 10.0  # at 5 % loss: percent of sets, and of p99
_COLORS = {"receiver": "#4477aa", "decoder": "#ee8866", "others": "#bbbbbb", "MainThread": "#44bb99"}
_THREADS = {
    "receiver": "receive",
    "decoder": "decode, demosaic",
    "MainThread": "consumer",
    "others": "libraries",
}

Section = Any


def page(results: Mapping[str, Section]) -> str:
    """Everything that was measured; a section that was skipped says why, one never run is left out."""
    where = machine("numpy", "opencv-python-headless", "lcm", "pyzmq")
    parts = [f"## Transport\n\n`make bench-transport` on {where}."]
    for name, write in _WRITERS.items():
        section = results.get(name)
        if section is None:
            continue
        reason = section.get("skipped") if isinstance(section, dict) else None
        parts.append(f"### {_TITLES[name]}\n\nNot measured: {reason}." if reason else write(section))
    return "\n\n".join(parts)


def _rig(section: Section) -> str:
    first = json.loads(FIRST_VERSION.read_text())
    columns = [("first version", first["rig"]), ("now", section)]
    picture("transport_rig", (6.4, 1.6), lambda axes: _draw_threads(axes, columns))
    rows = [[label, *(form(one) for _, one in columns), bar] for label, form, bar in _RIG_ROWS]
    table = markdown_table(["", *(name for name, _ in columns), "bar"], rows)
    return f"""### {_TITLES["rig"]}

Frames of {section["frame_kib"]:.0f} KiB ({section["frames"]}), encoded once, played by one process
through the agents' uplink over loopback UDP, each camera at a phase of its own; the server is a process of
its own, decodes and demosaics every frame, and its sets are taken as by a user's program.
{section["expected_sets"]} sets. Of up to {section["tries"]} runs the one that other programs disturbed least.
The sender took {section["sender_cores"]:.2f} cores; loopback does the kernel's part of receiving in it.

{table}

Where the server's time goes:

![Processor time by thread](images/transport_rig.svg)"""


def _floor(section: Section) -> str:
    rows = [
        [
            label,
            f"{section[f'cpu_s_per_gb_{way}']:.2f}",
            f"{section[f'bare_cpu_s_per_gb_{way}']:.2f}",
            f"{section[f'ratio_{way}']:.2f}",
        ]
        for way, label in (("gro", "merged (UDP_GRO)"), ("plain", "one by one"))
    ]
    table = markdown_table(["datagrams", "ours, CPU s/GB", "bare loop, CPU s/GB", "ratio"], rows)
    return f"""### {_TITLES["floor"]}

From the socket to the event that a frame is whole, against a loop in the same language that receives the same
traffic and looks at nothing. Medians of alternating runs.

{table}"""


def _peers(section: Section) -> str:
    rows = [
        [
            peer["name"],
            f"{peer['mb_s']:.0f}",
            f"{peer['cpu_s_per_gb']:.2f}",
            f"{peer['sender_cpu_s_per_gb']:.2f}",
            f"{100 * peer['lost_without_drops']:.1f} %",
            f"{100 * peer['lost']:.1f} %",
        ]
        for peer in section
    ]
    header = [
        "transport",
        "MB/s before loss",
        "receiver CPU s/GB",
        "sender CPU s/GB",
        "frames lost",
        "... at 1 % drops",
    ]
    picture("transport_peers", (6.4, 1.8), lambda axes: _draw_peers(axes, section))
    return f"""### {_TITLES["peers"]}

The rig's frames, whole ones counted, between two network namespaces with Ethernet's frame size; a frame
that its sender had to give up is lost, too. LCM sends 64-KB datagrams, which IP cuts; ZeroMQ runs over
TCP with four frames of queue a camera. Processor time and loss at the rig's rate.

{markdown_table(header, rows)}

![Frames lost at 1 % drops](images/transport_peers.svg)"""


def _recovery(section: Section) -> str:
    rows = [
        [
            one["fault"],
            str(one["sets"]),
            f"{100 * one['incomplete']:.3f} %",
            f"{one['added_p99_ms']:.1f}",
            f"{100 * one['resent_share']:.2f} %",
        ]
        for one in section
    ]
    picture("transport_recovery", (6.4, 2.4), lambda axes: _draw_recovery(axes, section))
    header = ["fault", "sets", "incomplete", "added p99 ms", "fragments resent"]
    return f"""### {_TITLES["recovery"]}

Twelve cameras at 30 frames/s in virtual time: real links, pacers and synchroniser, faults on both directions
of every path (a burst is an outage of one camera's path, once a second on average; reordered datagrams come
5 ms late), agents that get to their mail 0.3 ms late on average. Nothing of the machine is in these figures,
and the same seeds give them again. The latency is that from a set's last exposure to the set.

{markdown_table(header, rows)}

![Recovery over loss](images/transport_recovery.svg)"""


def _switch(section: Section) -> str:
    rows = [
        [
            name,
            f"1/{case['slow_motion']}",
            f"{case['lost_sets']} of {case['lost_sets'] + case['complete_sets']}",
            f"{case['lost_frames']} of {case['lost_frames'] + case['frames']}",
            f"{100 * case['port_dropped']:.2f} %",
            f"{100 * case['port_load']:.1f} %",
            f"{case['delivered_fps']:.2f}",
        ]
        for name, case in section["cases"].items()
    ]
    header = ["load", "speed", "sets lost", "frames lost", "port dropped", "port busy", "fps delivered"]
    return f"""### {_TITLES["switch"]}

Network namespaces on one machine: {section["hosts"]} hosts with an agent's uplink each, a real server, and a
switch whose port to the PC is shaped to 1 Gbit/s, with {section["buffer_kib"]} KiB of buffer. Where two cores
are too few for all of them the load runs in slow motion: frame rate and port rate divided alike, the buffer
as it was.
Unpaced, every host sends its frame at once. RGB24 and 16-bit depth is the paper's format; 6.4 frames a second
of it is what the port carries: delivered {100 * section["raw_ceiling_ratio"]:.1f} % of that.

{markdown_table(header, rows)}"""


def _chaos(section: Section) -> str:
    rows = [
        [
            one["case"],
            f"{one['recovered_s']:.2f}",
            str(one["incomplete_sets"]),
            f"{one['resident_mib']:.0f}",
        ]
        for one in section
    ]
    header = ["case", "whole sets again after s", "incomplete sets", "server's memory, MiB"]
    return f"""### {_TITLES["chaos"]}

Twelve real `rig-agent` processes at 10 frames/s, a real server process, a relay between them as the cable.
Clocks jump where time enters the programs, not on the machine.

{markdown_table(header, rows)}"""


def _clock(section: Section) -> str:
    from bench_clock import table

    costs = ", ".join(f"{name.removesuffix('_us')} {us:.1f} µs" for name, us in section["cost"].items())
    return f"""### {_TITLES["clock"]}

Errors of rig time against truth, in simulation unless the line says otherwise; what is stated with each
frame, and the error over that, which is about 1 where the statement is honest and below where it is cautious.
Bars: p99 below 500 µs, on loopback below 100 µs.

{table(section)}

Processor time: {costs}."""


_TITLES = {
    "rig": "The rig: twelve cameras, 30 frames a second, lossless",
    "floor": "Receive path against a bare loop",
    "peers": "Other transports",
    "recovery": "Loss and recovery",
    "switch": "Twelve hosts and a switch with one gigabit port",
    "chaos": "What breaks, and how soon the stream is back",
    "clock": "Clocks",
}
_WRITERS: dict[str, Callable[[Section], str]] = {
    "rig": _rig,
    "floor": _floor,
    "peers": _peers,
    "recovery": _recovery,
    "switch": _switch,
    "chaos": _chaos,
    "clock": _clock,
}
_RIG_ROWS: Sequence[tuple[str, Callable[[Section], str], str]] = (
    ("complete sets", lambda one: f"{100 * one['complete_sets']:.2f} %", "≥ 99.9 %"),
    ("sets a second", lambda one: f"{one['fps']:.2f}", "30"),
    ("server process, cores", lambda one: f"{one['server_cores']:.2f}", "≤ 1.3"),
    ("last datagram → set, median ms", lambda one: f"{one['p50_ms']:.1f}", ""),
    ("last datagram → set, p99 ms", lambda one: f"{one['p99_ms']:.1f}", "≤ 20"),
    ("memory growth, MB", lambda one: f"{one['rss_growth_mb']:+.1f} of {one['rss_mb']:.0f}", "flat"),
    ("page faults a second", lambda one: f"{one['minor_faults_per_s']:.0f}", ""),
    ("cores that other programs took meanwhile", lambda one: f"{one['others_cores']:.2f}", ""),
    ("authenticated", lambda one: "yes" if one["authenticated"] else "no", "yes"),
)


def _draw_threads(axes: Axes, columns: Sequence[tuple[str, Section]]) -> None:
    names = [name for name, _ in columns]
    left = [0.0] * len(columns)
    for thread, label in _THREADS.items():
        widths = [one["thread_cores"].get(thread, 0.0) for _, one in columns]
        axes.barh(names, widths, left=left, color=_COLORS[thread], label=label, height=0.6)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.axvline(1.3, color="black", linestyle=":", linewidth=1)
    axes.invert_yaxis()
    axes.set_xlabel("cores (dotted: what the rig may take)")
    axes.legend(ncols=4, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_peers(axes: Axes, section: Section) -> None:
    lost = [100 * peer["lost"] for peer in section]
    bars = axes.barh([peer["name"] for peer in section], lost, color="#4477aa", height=0.6)
    axes.bar_label(bars, [f"{value:.1f} %" for value in lost], padding=3)
    axes.invert_yaxis()
    axes.set_xlim(0, 115)
    axes.set_xlabel("frames lost where 1 % of the packets are dropped, %")


def _draw_recovery(axes: Axes, section: Section) -> None:
    points = sorted(
        (float(one["fault"].split()[1]), 100 * one["incomplete"], one["added_p99_ms"])
        for one in section
        if one["fault"].startswith("loss ")
    )
    loss, incomplete, added_ms = zip(*points, strict=True)
    axes.plot(loss, incomplete, "o-", color="#4477aa", label="incomplete sets, %")
    axes.axhline(_INCOMPLETE_BAR, color="black", linestyle=":", linewidth=1)
    axes.set_ylim(0, 1.2 * max(_INCOMPLETE_BAR, *incomplete))
    axes.set_xlabel("random loss, % (dotted: the bars of both)")
    axes.set_ylabel("incomplete sets, %")
    beside = axes.twinx()
    beside.spines["right"].set_visible(True)
    beside.plot(loss, added_ms, "s--", color="#ee8866", label="added p99, ms")
    beside.set_ylim(0, 1.2 * max(_ADDED_BAR_MS, *added_ms))
    beside.set_ylabel("added p99, ms")
    axes.figure.legend(ncols=2, frameon=False, loc="outside upper center")
