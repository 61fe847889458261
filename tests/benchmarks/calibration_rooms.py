"""Rooms that are not the simulator's: an independent renderer's, and a real office with motion capture.

python tests/benchmarks/calibration_rooms.py
"""

from calibration_study import in_processes  # isort: skip  # sets threads before NumPy is imported

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from calibration_trial import Trial, judge

from rig_calib.calibration import calibrate
from rig_calib.rig_folder_calibration import read_views
from rig_calib.settings import CalibrationSettings
from rig_protocol.rig_folder import read_rig_description, read_true_poses
from support.real_data import real_data


@dataclass(frozen=True, slots=True)
class Room:
    """A rig folder with a truth and how many of its frames are used."""

    title: str
    folder: str
    frames: int


ROOMS = (
    Room("independently rendered room, 1 frame", "rendered_room", 1),
    Room("independently rendered room, 2 frames", "rendered_room", 2),
    Room("real office, hand-held, no patterns, no drawing", "tum_fr1_rpy_12views", 1),
)


def run() -> list[dict[str, Any]]:
    """One record a room; a pytest skip where the data are absent."""
    for room in ROOMS:
        real_data(room.folder)
    return list(in_processes(_measure, ROOMS))


def _measure(room: Room) -> dict[str, Any]:
    folder = real_data(room.folder)
    description = read_rig_description(folder)
    truth = read_true_poses(folder / "truth.json")
    views = read_views(folder, description, room.frames)
    result = calibrate(views, description.ring, CalibrationSettings())
    return {"case": room.title, **_figures(judge(0, result, views, truth))}


def _figures(trial: Trial) -> dict[str, Any]:
    errors = list(trial.edges.values())
    return {
        "cameras_missing": len(trial.missing),
        "deg": trial.deg,
        "mm": trial.mm,
        "median_deg": float(np.median([error.deg for error in errors])),
        "median_mm": float(np.median([error.mm for error in errors])),
        "near_deg": float(np.mean([error.deg for error in trial.near])),
        "near_mm": float(np.mean([error.mm for error in trial.near])),
        "worst_mm": max(error.mm for error in errors),
        "absolute_mm": trial.absolute_mm,
        "nominal_mm": trial.nominal_mm,
        "nees": None if trial.pairs_nees is None else trial.pairs_nees.nees,
        "nees_dof": None if trial.pairs_nees is None else trial.pairs_nees.dof,
        "seconds": trial.seconds["total"],
        "failures": list(trial.failures),
    }


def main() -> None:
    """Print the figures."""
    print(json.dumps(run(), indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
