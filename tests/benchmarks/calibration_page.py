"""The figures of docs/accuracy.md and their pictures, from the section `calibration` of bench.json."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from calibration_robustness import OUTCOMES
from matplotlib.axes import Axes

from support.benchmark_record import machine, markdown_table
from support.pictures import picture

_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#4477aa", "#ee8866", "#44bb99", "#cc3311", "#bbbbbb"
_OUTCOME_COLORS = dict(zip(OUTCOMES, (_GREEN, _BLUE, _ORANGE, "#aa3377", _RED, "black"), strict=True))
_REFERENCE = {"one_frame": "1 frame", "ten_frames": "10 frames"}

Section = Any


def page(results: Mapping[str, Section]) -> str:
    """Everything that was measured; a section that was skipped says why, one never run is left out."""
    where = machine("numpy", "opencv-python-headless", "scipy")
    parts = [f"## Figures\n\n`make bench-calibration` on {where}."]
    if any("deg" in results.get(name, {}) for name in _REFERENCE):
        parts.append(_reference(results))
    for name, (title, write) in _WRITERS.items():
        section = results.get(name)
        if section is None:
            continue
        reason = section.get("skipped") if isinstance(section, dict) else None
        parts.append(f"### {title}\n\n" + (f"Not measured: {reason}." if reason else write(section)))
    return "\n\n".join(parts)


def _reference(results: Mapping[str, Section]) -> str:
    known = {title: results[name] for name, title in _REFERENCE.items() if "deg" in results.get(name, {})}
    rows = [[label, *(form(one) for one in known.values()), bar] for label, form, bar in _REFERENCE_ROWS]
    picture("calibration_bound", (6.4, 2.8), lambda axes: _draw_bound(axes, known))
    seeds = max(one["seeds"] for one in known.values())
    return f"""### Reference scene

{seeds} rooms.

{markdown_table(["", *known, "bar"], rows)}

![Errors and bounds by room](images/calibration_bound.svg)"""


def _both(one: Section, key: str) -> str:
    if f"{key}deg" not in one:  # a section that was measured before there was such a figure
        return "–"
    return f"{one[f'{key}deg']:.3f}° / {one[f'{key}mm']:.2f} mm"


def _nees(one: Section, key: str) -> str:
    return f"{one[key]:.2f} ({one[f'{key}_low']:.2f} to {one[f'{key}_high']:.2f})"


_REFERENCE_ROWS: Sequence[tuple[str, Callable[[Section], str], str]] = (
    ("mean error of neighbours", lambda one: _both(one, ""), ""),
    ("RMS error of neighbours", lambda one: _both(one, "rmse_"), ""),
    ("Cramér-Rao bound of that", lambda one: _both(one, "bound_"), ""),
    ("efficiency", lambda one: f"{one['efficiency_deg']:.2f} / {one['efficiency_mm']:.2f}", "≥ 0.7"),
    ("bound of its own points", lambda one: _both(one, "bound_of_tracks_"), ""),
    ("bound of the images", lambda one: _both(one, "bound_of_images_"), ""),
    ("mean error of opposite cameras", lambda one: _both(one, "opposite_"), ""),
    ("... over that of neighbours", lambda one: f"{one['opposite_ratio']:.2f}", "≤ 2"),
    ("NEES of pairs (95 % interval)", lambda one: _nees(one, "nees"), "inside"),
    ("NEES of cameras (95 % interval)", lambda one: _nees(one, "nees_cameras"), "inside"),
    ("not worse than the drawing", lambda one: f"{100 * one['not_worse_than_drawing']:.0f} %", "≥ 95 %"),
    ("true matches an edge", lambda one: f"{one['true_matches_an_edge']:.0f}", ""),
    ("noise of a small keypoint, px", lambda one: f"{one['keypoint_sigma_px']:.3f}", ""),
)


def _draw_bound(axes: Axes, known: Mapping[str, Section]) -> None:
    for (title, one), color in zip(known.items(), (_BLUE, _ORANGE), strict=False):
        each = [trial for trial in one["each"] if trial.get("rmse_mm") is not None]
        seeds = [trial["seed"] for trial in each]
        axes.plot(seeds, [trial["rmse_mm"] for trial in each], "o", color=color, label=f"{title}: RMS error")
        bounds = [trial["bound_mm"] for trial in each]
        axes.plot(seeds, bounds, "_", color=color, markersize=14, label=f"{title}: bound")
    axes.set_ylim(bottom=0)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel("room (seed)")
    axes.set_ylabel("translation of neighbours, mm")
    axes.figure.legend(ncols=4, frameon=False, loc="outside upper center", fontsize=8)


def _time(section: Section) -> str:
    stages = {stage: value for stage, value in section["stages"].items() if stage not in ("load", "total")}
    rows = [[stage, f"{1e3 * value:.0f}"] for stage, value in stages.items()]
    rows.append(["**total**", f"**{1e3 * section['seconds']:.0f}**"])
    picture("calibration_time", (6.4, 1.2), lambda axes: _draw_stages(axes, stages))
    peers = [
        [peer["name"], f"{1e3 * peer['seconds']:.0f}", f"{peer['deg']:.3f}° / {peer['mm']:.2f} mm"]
        for peer in section["peers"]
        if "skipped" not in peer
    ]
    return f"""Twelve cameras, one frame, images in memory, {section["cores"]} cores; medians of five runs
after a first one, which took {section["first_s"]:.1f} s. Bar: 800 ms.

{markdown_table(["stage", "ms"], rows)}

![Stages](images/calibration_time.svg)

The adjustment beside GTSAM's on the same matches. GTSAM starts from the drawing, and building its graph in
Python is not counted; its factors know no depth bias, so it is also given the depth that ours corrected.

{markdown_table(["adjustment", "ms", "neighbours, mean"], peers)}"""


def _draw_stages(axes: Axes, stages: Mapping[str, float]) -> None:
    left = 0.0
    for (stage, value), color in zip(stages.items(), (_BLUE, _ORANGE, _GREEN, _RED, _GREY), strict=False):
        axes.barh([""], [1e3 * value], left=left, color=color, label=stage, height=0.6)
        left += 1e3 * value
    axes.axvline(800, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel("ms (dotted: the bar)")
    axes.figure.legend(ncols=4, frameon=False, loc="outside upper center")


def _robustness(section: Section) -> str:
    rows = [
        [
            one["case"],
            str(one["seeds"]),
            "–" if one["deg"] is None else f"{one['deg']:.3f}° / {one['mm']:.2f} mm",
            *(f"{100 * one[key]:.0f} %" for key in OUTCOMES),
            "–" if one["not_worse_than_drawing"] is None else f"{100 * one['not_worse_than_drawing']:.0f} %",
        ]
        for one in section
    ]
    header = ["case", "seeds", "neighbours that were placed, mean", *OUTCOMES.values(), "≤ drawing"]
    picture("calibration_robustness", (6.4, 2.6), lambda axes: _draw_outcomes(axes, section))
    return f"""{markdown_table(header, rows)}

![Outcomes](images/calibration_robustness.svg)"""


def _draw_outcomes(axes: Axes, section: Section) -> None:
    names = [one["case"] for one in section]
    left = np.zeros(len(section))
    for key, label in OUTCOMES.items():
        shares = np.array([100 * one[key] for one in section])
        axes.barh(names, shares, left=left, color=_OUTCOME_COLORS[key], label=label, height=0.6)
        left += shares
    axes.invert_yaxis()
    axes.set_xlabel("% of seeds")
    axes.figure.legend(ncols=3, frameon=False, loc="outside upper center", fontsize=8)


def _table_1(section: Section) -> str:
    rows = [
        ["correspondences of a pair", *_numbers(section, "correspondences", 0)],
        ["initial rotation, °", *_numbers(section, "initial_deg", 2)],
        ["optimised rotation, °", *_numbers(section, "optimised_deg", 2)],
        ["initial translation, cm", *_numbers(section, "initial_cm", 2)],
        ["optimised translation, cm", *_numbers(section, "optimised_cm", 2)],
    ]
    header = ["threshold / smallest distance", *(f"{one:g}" for one in section["multiples"]), "`joint`"]
    picture("calibration_table_1", (6.4, 2.4), lambda axes: _draw_table(axes, section))
    return f"""Table I of the paper with `--method paper` on the simulated ring, means over {section["seeds"]}
rooms; in brackets what the paper printed for its own rig. `joint` on the same frames in the last column.

{markdown_table(header, rows)}

![Translation error over the threshold](images/calibration_table_1.svg)"""


def _numbers(section: Section, key: str, digits: int) -> list[str]:
    """Ours with the paper's in brackets, and ours of `joint`."""

    def shown(value: float | None) -> str:
        return "–" if value is None else f"{value:.{digits}f}"

    pairs = zip(section[key], section["paper"][key], strict=True)
    return [*(f"{shown(ours)} ({shown(paper)})" for ours, paper in pairs), shown(section["joint"][key])]


def _draw_table(axes: Axes, section: Section) -> None:
    for key, style in (("initial_cm", "--"), ("optimised_cm", "-")):
        label = key.removesuffix("_cm")
        axes.plot(section["multiples"], section["paper"][key], style, color=_GREY, label=f"printed, {label}")
        axes.plot(section["multiples"], section[key], style, color=_BLUE, label=f"`paper`, {label}")
    axes.axhline(section["joint"]["optimised_cm"], color=_ORANGE, label="`joint`")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("threshold / smallest distance")
    axes.set_ylabel("translation error, cm")
    axes.figure.legend(ncols=3, frameon=False, loc="outside upper center", fontsize=8)


def _rooms(section: Section) -> str:
    rows = [
        [
            one["case"],
            f"{one['near_deg']:.3f}° / {one['near_mm']:.2f} mm",
            f"{one['worst_mm']:.1f}",
            f"{one['absolute_mm']:.1f}",
            "–" if one["nominal_mm"] is None else f"{one['nominal_mm']:.1f}",
            "–" if one["nees"] is None else f"{one['nees']:.2f}",
            "; ".join(one["failures"]) or "–",
        ]
        for one in section
    ]
    header = [
        "room",
        "near pairs, mean",
        "worst neighbour, mm",
        "cameras, mm",
        "drawing, mm",
        "NEES",
        "refused",
    ]
    return f"""Neither the simulator's nor tuned to. Bar of the rendered room with two frames: 0.10° / 3.5 mm.
In the real office the camera was carried by hand: motion and the synchronisation of motion capture add
0.5–1° to any error, which no covariance knows.

{markdown_table(header, rows)}"""


def _drift(section: Section) -> str:
    from calibration_drift import tables

    return f"""Two people walk around the rig all the time, no patterns. Bar: bumps found within 60 frames,
camera named, no false alarm in 10,000 frames (`BENCH_FULL=1` watches all of them).

{tables(section)}"""


def _pose_graph(section: Section) -> str:
    rows = [
        [
            peer["graph"],
            peer["name"],
            str(peer["poses"]),
            f"{peer['seconds']:.2f}",
            f"{peer['chordal']:.1f}",
            f"{peer['geodesic']:.1f}",
        ]
        for peer in section["peers"]
    ]
    header = ["graph", "solver", "poses", "seconds", "chordal objective", "geodesic"]
    return f"""Certified optimum of the chordal objective on `sphere2500`: 1687.

{markdown_table(header, rows)}"""


def _pattern(section: Section) -> str:
    from calibration_pattern import table

    return f"Keypoints and matches as in figures 2 and 3 of the paper.\n\n{table(section)}"


_WRITERS: Mapping[str, tuple[str, Callable[[Section], str]]] = {
    "time": ("Time", _time),
    "robustness": ("Trouble", _robustness),
    "table_1": ("The paper's method", _table_1),
    "rooms": ("Other rooms", _rooms),
    "drift": ("Drift watch", _drift),
    "pose_graph": ("Pose graphs", _pose_graph),
    "pattern": ("Patterns", _pattern),
}
