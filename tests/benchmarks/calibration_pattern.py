"""What descriptor patterns bring: keypoints and matches in the natural room against the room with patterns.

As in figures 2 and 3 of the paper, on the simulated ring: SIFT keypoints of whole images; for every pair of
neighbours the matches that the paper's rule accepts (nearest descriptor by FLANN, at most three times the
smallest distance apart) in the whole image and in the predicted overlap, and those of the default method. The
simulator's truth says which matches are right: the matched pixel lies where the point really is.

Run: python tests/benchmarks/calibration_pattern.py
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.simulator.kinect import VirtualKinect
from rig_agent.simulator.ring import VirtualRig, rig_description
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.features import Keypoints, detect
from rig_calib.matching import Matches, flann_matches, mutual_matches
from rig_calib.overlap import Region, shared_regions, whole_image
from rig_calib.settings import CalibrationSettings
from rig_protocol.frames import ImageU8
from rig_protocol.poses import inverse, transform_points
from support.benchmark_record import markdown_table

SEEDS = range(5 if os.environ.get("BENCH_FULL") else 2)
ALL_KEYPOINTS = 0
PAPER_MULTIPLE = 3.0  # of the smallest descriptor distance, as for figure 3
OVERLAP_MARGIN_DEG = 7.0  # as the calibration takes it
RIGHT_PX = 3.0  # lens error and sub-pixel noise are smaller, another blob is further away

PAPER: dict[str, dict[str, Any]] = {
    "natural": {"keypoints": 406, "whole image": (56, 32)},
    "patterns": {"keypoints": 1231, "whole image": (116, 30), "overlap": ("all", 0)},
}
"""What the paper counts: keypoints an image (SURF), and matches that are right and wrong."""

Regions = tuple[Region, Region]
Rule = Callable[[Keypoints, Keypoints], Matches]


def run() -> dict[str, Any]:
    """Means over images and over pairs of neighbours, for both kinds of room."""
    rooms = {"natural": False, "patterns": True}
    return {
        "seeds": len(SEEDS),
        **{room: _mean([count_room(seed, patterns) for seed in SEEDS]) for room, patterns in rooms.items()},
    }


def count_room(seed: int, patterns: bool) -> dict[str, float]:
    """One ring in one room: keypoints an image, right and wrong matches a pair by each rule."""
    settings = SimulatorSettings(seed=seed, patterns=patterns)
    rig = VirtualRig(settings)
    description = rig_description(settings)
    models = {camera.id: camera.model.color for camera in description.cameras}
    nominal = {camera.id: camera.T_rig_camera for camera in description.cameras}
    overlaps = shared_regions(models, nominal, OVERLAP_MARGIN_DEG)
    sigma_px = CalibrationSettings().pixel_sigma
    keypoints = {
        i: detect(grey_image(rig.camera(i)), whole_image(models[i]), ALL_KEYPOINTS, sigma_px) for i in models
    }
    counts: list[dict[str, float]] = []
    for i, j in (tuple(sorted(pair)) for pair in settings.overlaps):
        regions = {"whole image": (whole_image(models[i]), whole_image(models[j])), "overlap": overlaps[i, j]}
        for name, rule in rules(regions, seed).items():
            matches = rule(keypoints[i], keypoints[j])
            right = are_right(rig.camera(i), rig.camera(j), keypoints[i], keypoints[j], matches)
            counts.append({f"{name}: right": int(right.sum()), f"{name}: wrong": int((~right).sum())})
    found = float(np.mean([len(one) for one in keypoints.values()]))
    return {"keypoints": found} | _mean(counts)


def rules(regions: dict[str, Regions], seed: int) -> dict[str, Rule]:
    """The paper's rule in the whole image and in the overlap, and the default method's in the overlap."""
    settings = CalibrationSettings()

    def paper(where: str) -> Rule:
        return lambda a, b: flann_matches(a, b, regions[where], PAPER_MULTIPLE, seed)

    def default(a: Keypoints, b: Keypoints) -> Matches:
        return mutual_matches(a, b, regions["overlap"], settings.match_ratio, settings.match_max_distance)

    return {"whole image": paper("whole image"), "overlap": paper("overlap"), "default": default}


def grey_image(camera: VirtualKinect) -> ImageU8:
    """What the camera delivers, as the calibration sees it."""
    bayer = camera.frame(0).bayer
    assert bayer is not None
    return np.asarray(cv2.cvtColor(cv2.cvtColor(bayer, cv2.COLOR_BayerGRBG2BGR), cv2.COLOR_BGR2GRAY))


def are_right(
    i: VirtualKinect, j: VirtualKinect, a: Keypoints, b: Keypoints, matches: Matches
) -> npt.NDArray[np.bool_]:
    """Which matches (N,2) pair pixels of one place of the room."""
    pixels_i, pixels_j = a.pixels[matches[:, 0]], b.pixels[matches[:, 1]]
    if not len(matches):
        return np.zeros(0, bool)
    view_i, view_j = i.view(), j.view()
    column, row = np.rint(pixels_i).astype(int).T
    z_m = view_i.color_z_m()[row, column].astype(np.float64)
    told = i.unit.color
    K = np.array([[told.fx, 0, told.cx], [0, told.fy, told.cy], [0, 0, 1]])
    rays = cv2.undistortPoints(pixels_i[:, None], K, np.array(told.dist))[:, 0]
    points = np.column_stack([rays * z_m[:, None], z_m])
    in_j = transform_points(inverse(view_j.T_room_color) @ view_i.T_room_color, points)
    seen = j.unit.color
    K = np.array([[seen.fx, 0, seen.cx], [0, seen.fy, seen.cy], [0, 0, 1]])
    expected = cv2.projectPoints(in_j, np.zeros(3), np.zeros(3), K, np.array(seen.dist))[0][:, 0]
    near = np.linalg.norm(expected - pixels_j, axis=1) < RIGHT_PX
    return np.asarray(near & (z_m > 0) & (in_j[:, 2] > 0))


def table(results: dict[str, Any]) -> str:
    """The counts beside the paper's."""
    rows = []
    for room in ("natural", "patterns"):
        ours, paper = results[room], PAPER[room]
        rows.append([f"{room}: keypoints an image", f"{ours['keypoints']:.0f}", str(paper["keypoints"])])
        for rule in ("whole image", "overlap", "default"):
            mine = f"{ours[f'{rule}: right']:.1f} / {ours[f'{rule}: wrong']:.1f}"
            rows.append([f"{room}: {rule}, right / wrong", mine, " / ".join(map(str, paper.get(rule, "–")))])
    return markdown_table(["mean of an image or pair of neighbours", "simulated ring", "paper"], rows)


def _mean(counts: list[dict[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: float(np.mean([one[name] for one in counts if name in one])) for name in names}


if __name__ == "__main__":
    print(table(run()))
