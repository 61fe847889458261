"""By how much a camera moved in the still room, from what it sees now and what it saw before."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.drift.landmarks import track
from rig_calib.drift.look import Look
from rig_calib.drift.motion import Measurements, Motion, estimate_motion
from rig_calib.drift.reference import Reference

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

CHANGED_STEPS = 5.0
"""A block whose disparity is off by more from what the camera's motion explains shows something else."""
_MIN_STILL = 0.35  # share of the blocks, else a camera is covered, or looks elsewhere
_FAR_PX, _FAR_ROUNDS = 4.0, 4  # full pixels; how often shifts are looked for anew from where they were found
_MIN_LANDMARKS = 25
_UNANIMOUS = 0.9  # of the landmarks; bumps have 0.96 and more, furniture that was moved less
_SETTLED_STEPS = 0.5  # of disparity
_ROUNDS = 3  # of finding the still part by the motion, and the motion by the still part


@dataclass(frozen=True, slots=True, eq=False)
class OwnView:
    """One look against the reference: `motion`, None when too little of the view is still.

    `still`: which blocks (N,) show what they showed.
    """

    still: Mask
    motion: Motion | None


def compare(reference: Reference, look: Look, far: Array | None = None) -> OwnView:
    """Find the still part of the view and by how much the camera moved in it.

    `far`: a motion (6,) of which it is known that the camera may have made it.
    """
    change = reference.blocks.changes(reference.look.disparity, look.disparity)
    starts = [np.zeros(6), *([] if far is None else [far])]
    start = max(starts, key=lambda delta: _still(reference, change, delta).sum())
    for _ in range(_FAR_ROUNDS):
        view = _near(reference, look, change, start)
        if view.motion is None or not _is_far(reference, view.motion.delta - start):
            break
        start = view.motion.delta
    return view


def _near(reference: Reference, look: Look, change: Array, delta: Array) -> OwnView:
    """The view when the camera moved by about delta: shifts are looked for around those that it makes."""
    blocks = reference.blocks
    shifts, found = track(
        reference.look.contrast,
        look.contrast,
        reference.landmarks,
        reference.tensors,
        reference.noise_levels,
        expected=reference.jacobian @ delta if delta.any() else None,
    )
    for _ in range(_ROUNDS):
        still = _still(reference, change, delta)
        usable = found & (reference.block >= 0) & undisturbed(still, blocks.shape)[reference.block]
        if still.sum() < _MIN_STILL * blocks.known.sum() or usable.sum() < _MIN_LANDMARKS:
            return OwnView(still, None)
        depth = _depth(reference, change, still & blocks.flat)
        seen = shifts.whitened(reference.jacobian, usable)
        motion = estimate_motion((seen, depth), delta)
        if motion is None or np.abs(blocks.jacobian @ (motion.delta - delta)).max() < _SETTLED_STEPS:
            break
        delta = motion.delta
    return OwnView(still, motion if motion is not None and _is_unanimous(seen, motion.delta) else None)


def _is_unanimous(seen: Measurements, delta: Array) -> bool:
    """Whether the whole view moved: where furniture was moved, or people are many, parts of it did not."""
    count, share = seen.votes(delta)
    return count < _MIN_LANDMARKS or share >= _UNANIMOUS


def _is_far(reference: Reference, delta: Array) -> bool:
    """Whether a motion shifts the landmarks by more than can be followed exactly."""
    return bool(np.median(np.abs(reference.jacobian @ delta)) > _FAR_PX)


def _still(reference: Reference, change: Array, delta: Array) -> Mask:
    """Blocks whose change the motion explains."""
    expected = reference.blocks.jacobian @ delta
    return np.asarray(reference.blocks.known & (np.abs(change - expected) < CHANGED_STEPS))


def _depth(reference: Reference, change: Array, use: Mask) -> Measurements:
    sigma = reference.noise_steps
    residual = np.column_stack([change[use] / sigma, np.zeros(use.sum())])
    jacobian = np.zeros((len(residual), 2, 6))
    jacobian[:, 0] = reference.blocks.jacobian[use] / sigma
    return Measurements(residual, jacobian, rows=1)


def undisturbed(still: Mask, shape: tuple[int, int]) -> Mask:
    """Still blocks whose neighbours are still, too: what hides a block blurs into the one beside it."""
    eroded = cv2.erode(still.reshape(shape).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(eroded.ravel() > 0)
