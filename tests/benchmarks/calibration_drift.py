"""The drift watch against its bars: bumps of 0.5° or 5 mm found within 60 frames, no false alarm in 10,000.

Rooms without patterns, fresh correlated noise in every frame, two people walking around the rig all the time.
The watch looks at one frame in four, as in the server. BENCH_FULL=1: all of the 10,000 frames, more bumps.
"""

import copy
import os
import statistics
import sys
import time
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.benchmark_record import markdown_table
from support.drift_rooms import LEARNT_FRAMES, DriftRoom, look_of, watched_frames

PROCESSES = 2
PEOPLE = 2
BUMPS = (("0.5°", 0.5, 0.0), ("5 mm", 0.0, 5.0))
MOST_FRAMES = 60
CAMERAS = 12
QUIET_ROOMS = range(100, 120)
QUIET_FRAMES = {False: 260, True: 520}  # a room
BUMPED_ROOMS = {False: range(200, 204), True: range(200, 220)}
BUMPED_CAMERAS = 4  # of each room, each by each bump
LATER_FRAMES = 12  # from the end of learning to the bump

Bump = dict[str, Any]


def bumped_room(seed: int) -> list[Bump]:
    """Bumps of some cameras of one room: which camera was named, how many frames after the bump."""
    room = DriftRoom(seed, PEOPLE)
    bump_frame = LEARNT_FRAMES + LATER_FRAMES
    looks = {k: room.looks(k) for k in watched_frames(0, bump_frame + MOST_FRAMES)}
    learnt = room.watch()
    for frame in watched_frames(0, bump_frame):
        learnt.take(looks[frame])
    found = []
    for number in range(BUMPED_CAMERAS):
        camera = (seed + number * CAMERAS // BUMPED_CAMERAS) % CAMERAS
        for name, deg, mm in BUMPS:
            kinect = room.knocked(camera, deg, mm, bump_frame)
            watch = copy.deepcopy(learnt)
            told: Bump = {"bump": name, "camera": camera, "named": [], "frames": None}
            for frame in watched_frames(bump_frame, bump_frame + MOST_FRAMES):
                watch.take(looks[frame] | {camera: look_of(kinect, frame)})
                if (moved := watch.status().moved) and told["frames"] is None:
                    told["named"] = [one.camera for one in moved]
                    told["frames"] = frame - bump_frame + 1
                if camera in {one.camera for one in moved}:
                    last = next(one for one in moved if one.camera == camera)
                    told["error_deg"], told["error_mm"] = last.deg - deg, last.mm - mm
            found.append(told)
    return found


def quiet_room(task: tuple[int, int]) -> dict[str, Any]:
    """A room in which nothing moves but people: the alarms that were raised, and what a look costs."""
    seed, frames = task
    room = DriftRoom(seed, PEOPLE)
    watch = room.watch()
    alarms: dict[int, str | None] = {}
    seconds, judged = [], []
    for frame in watched_frames(0, frames):
        looks = room.looks(frame)
        began = time.process_time()
        watch.take(looks)
        status = watch.status()
        alarms |= {one.camera: one.found_by for one in status.moved}
        if frame > LEARNT_FRAMES:
            seconds.append(time.process_time() - began)
            judged.append(len(status.judged) / CAMERAS)
    return {
        "seed": seed,
        "frames": frames,
        "alarms": alarms,
        "look_s": statistics.mean(seconds),
        "judged": statistics.mean(judged),
    }


def run(full: bool) -> dict[str, Any]:
    """All of it, on two processes; prints the tables. The figures for `build/bench.json`."""
    # Read when the processes start.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = "1"
    with get_context("spawn").Pool(PROCESSES, initializer=_one_thread) as pool:
        bumps = [one for room in pool.imap(bumped_room, BUMPED_ROOMS[full]) for one in room]
        tasks = [(seed, QUIET_FRAMES[full]) for seed in QUIET_ROOMS]
        quiet = list(pool.imap(quiet_room, tasks))
    figures = {"bumps": [_summary(name, bumps) for name, _, _ in BUMPS], **_quiet_summary(quiet)}
    print(tables(figures))
    for one in bumps:
        if one["named"] != [one["camera"]]:
            print(f"  {one}")
    for room in quiet:
        if room["alarms"]:
            print(f"  {room}")
    return figures


def _one_thread() -> None:
    import cv2

    cv2.setNumThreads(1)


def _summary(name: str, bumps: Sequence[Bump]) -> dict[str, Any]:
    tried = [one for one in bumps if one["bump"] == name]
    right = [one for one in tried if one["named"] == [one["camera"]]]
    frames = sorted(one["frames"] for one in right)
    return {
        "bump": name,
        "tried": len(tried),
        "named": len(right),
        "frames_median": statistics.median(frames) if frames else None,
        "frames_max": frames[-1] if frames else None,
        "error_deg": statistics.median(abs(one["error_deg"]) for one in right) if right else None,
        "error_mm": statistics.median(abs(one["error_mm"]) for one in right) if right else None,
    }


def _quiet_summary(quiet: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "rooms": len(quiet),
        "frames": sum(room["frames"] for room in quiet),
        "false_alarms": sum(len(room["alarms"]) for room in quiet),
        "judged": statistics.mean(room["judged"] for room in quiet),
        "look_ms": 1e3 * statistics.mean(room["look_s"] for room in quiet),
    }


def tables(figures: dict[str, Any]) -> str:
    """Bumps found and rooms watched in peace, as Markdown."""
    rows = [
        [
            one["bump"],
            f"{one['named']} of {one['tried']}",
            *(f"{one[key]:.{digits}f}" if one[key] is not None else "–" for key, digits in _COLUMNS.items()),
        ]
        for one in figures["bumps"]
    ]
    header = ["bump", "named", "frames, median", "frames, most", "error °", "error mm"]
    quiet = [
        str(figures["rooms"]),
        str(figures["frames"]),
        str(figures["false_alarms"]),
        f"{100 * figures['judged']:.1f} %",
        f"{figures['look_ms']:.0f}",
    ]
    calm = ["rooms", "frames", "false alarms", "cameras judged", "ms a look at 12 cameras"]
    return markdown_table(header, rows) + "\n\n" + markdown_table(calm, [quiet])


_COLUMNS = {"frames_median": 0, "frames_max": 0, "error_deg": 3, "error_mm": 2}


if __name__ == "__main__":
    run(os.environ.get("BENCH_FULL") == "1")
