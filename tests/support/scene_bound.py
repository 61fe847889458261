"""The Cramér-Rao bounds of a rendered rig, computed once and kept beside its frames."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig_calib.tracks import Scene as TrackScene
from support.cramer_rao import Bound, cramer_rao
from support.image_information import image_sigmas
from support.offered_matches import Pair, TrueRig, keypoint_noise, offered_matches, track_matches
from support.rendered_rig import RenderedRig, code_hash

_HERE = Path(__file__).parent
_CODE = [
    _HERE / f"{name}.py"
    for name in ("cramer_rao", "image_information", "offered_matches", "disparity_statistics", "true_optics")
]


@dataclass(frozen=True, slots=True)
class SceneBound:
    """Least RMS errors, (degrees, millimetres), of each pair of neighbours and of each opposite pair.

    `of_images`: the same neighbours if keypoints were placed as well as the pixels' noise allows.
    `keypoint_sigma_px`: that of a keypoint of 1.5 px, as measured. `matches`: true ones on offer.
    """

    neighbours: Mapping[Pair, tuple[float, float]]
    opposite: Mapping[Pair, tuple[float, float]]
    of_images: Mapping[Pair, tuple[float, float]]
    keypoint_sigma_px: float
    matches: Mapping[Pair, int]


def scene_bound(rig: RenderedRig) -> SceneBound:
    """Computed, or read when it was computed before."""
    path = rig.folder / f"bound_{rig.frames}_{code_hash(_CODE)}.json"
    if not path.exists():
        path.write_text(json.dumps(_compute(rig)))
    stored = json.loads(path.read_text())
    pairs = {name: _with_pairs(stored[name]) for name in ("neighbours", "opposite", "of_images", "matches")}
    return SceneBound(**pairs, keypoint_sigma_px=stored["keypoint_sigma_px"])


def track_bound(rig: RenderedRig, scene: TrackScene) -> dict[Pair, tuple[float, float]]:
    """Least RMS errors of the neighbours from the points that an estimator followed, placed as it did."""
    true = TrueRig.of(rig)
    matches = track_matches(true, scene)
    noise = keypoint_noise(list(matches.values()))
    bound = cramer_rao(true, matches, {pair: noise.sigmas(found) for pair, found in matches.items()})
    return _with_pairs(_each(bound, rig.settings.overlaps))


def _compute(rig: RenderedRig) -> dict[str, Any]:
    true = TrueRig.of(rig)
    matches = offered_matches(true)
    noise = keypoint_noise(list(matches.values()))
    bound = cramer_rao(true, matches, {pair: noise.sigmas(found) for pair, found in matches.items()})
    of_images = cramer_rao(true, matches, image_sigmas(true, matches))
    half = rig.settings.cameras // 2
    return {
        "neighbours": _each(bound, rig.settings.overlaps),
        "opposite": _each(bound, [(i, i + half) for i in range(half)]),
        "of_images": _each(of_images, rig.settings.overlaps),
        "keypoint_sigma_px": noise.sigma_px(1.5),
        "matches": [[*pair, len(found)] for pair, found in matches.items()],
    }


def _each(bound: Bound, pairs: Sequence[Pair]) -> list[list[float]]:
    return [[*pair, *bound.rmse([pair])] for pair in pairs]


def _with_pairs(rows: Sequence[Sequence[Any]]) -> dict[Pair, Any]:
    """By pair (lower id first): one number, or a tuple of several."""
    return {(min(i, j), max(i, j)): tuple(values) if len(values) > 1 else values[0] for i, j, *values in rows}
