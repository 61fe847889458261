"""Pieces of furniture as boxes. Own frame: x along the wall, y from the wall into the room, z up."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rig_agent.simulator.surface import Box


@dataclass(frozen=True, slots=True)
class Piece:
    """Boxes that belong together and the floor they need: along the wall and into the room; metres."""

    width_m: float
    depth_m: float
    boxes: tuple[Box, ...]


Maker = Callable[[np.random.Generator], Piece]


def wardrobe(rng: np.random.Generator) -> Piece:
    """Two doors with a gap and knobs, as high as a person."""
    width, depth, height = rng.uniform(0.8, 1.0), rng.uniform(0.45, 0.6), rng.uniform(1.75, 2.0)
    door = (width / 2 - 0.015, 0.02, height - 0.12)
    boxes = [Box(0, depth / 2, 0, (width, depth, height), "wood")]
    for side in (-1, 1):
        boxes.append(Box(side * width / 4, depth + 0.011, 0.08, door, "wood"))
        boxes.append(Box(side * 0.05, depth + 0.035, height / 2, (0.03, 0.03, 0.1), "paint"))
    return Piece(width, depth + 0.05, tuple(boxes))


def bookshelf(rng: np.random.Generator) -> Piece:
    """Open shelves with books and gaps."""
    width, depth, height = rng.uniform(0.7, 0.9), rng.uniform(0.26, 0.34), rng.uniform(1.6, 1.9)
    boxes = [Box(0, 0.01, 0, (width, 0.02, height), "wood")]
    boxes += [Box(x, depth / 2, 0, (0.02, depth, height), "wood") for x in (-width / 2, width / 2)]
    levels = np.linspace(0.05, height - 0.02, 6)
    for level, above in zip(levels, [*levels[1:], None], strict=True):
        boxes.append(Box(0, depth / 2, level - 0.02, (width, depth, 0.02), "wood"))
        if above is not None:
            length = width * rng.uniform(0.3, 0.85)
            x = (width - 0.04 - length) / 2 * rng.choice([-1, 1])
            size = (length, depth * 0.7, (above - level) * rng.uniform(0.6, 0.85))
            boxes.append(Box(x, depth * 0.4, level, size, "books"))
    return Piece(width + 0.02, depth, tuple(boxes))


def table(rng: np.random.Generator) -> Piece:
    """A table with a box and a row of books on it."""
    width, depth, height = rng.uniform(1.0, 1.4), rng.uniform(0.55, 0.7), rng.uniform(0.7, 0.78)
    boxes = [Box(0, depth / 2, height - 0.03, (width, depth, 0.03), "wood")]
    for x in (-width / 2 + 0.05, width / 2 - 0.05):
        boxes += [Box(x, y, 0, (0.05, 0.05, height - 0.03), "wood") for y in (0.05, depth - 0.05)]
    x = rng.uniform(0.1, width / 2 - 0.2) * rng.choice([-1, 1])
    boxes.append(Box(x, depth * 0.4, height, (0.3, 0.25, rng.uniform(0.15, 0.35)), "carton"))
    boxes.append(Box(-x, depth * 0.35, height, (0.35, 0.16, 0.23), "books"))
    return Piece(width, depth, tuple(boxes))


def bed(rng: np.random.Generator) -> Piece:
    """A bed along the wall: frame, mattress, pillow, headboard."""
    width, depth = rng.uniform(1.85, 2.0), rng.uniform(0.8, 0.9)
    side = rng.choice([-1, 1])
    boxes = (
        Box(0, depth / 2, 0, (width, depth, 0.3), "wood"),
        Box(0, depth / 2, 0.3, (width - 0.06, depth - 0.04, 0.18), "fabric"),
        Box(side * (width / 2 - 0.3), depth / 2, 0.48, (0.4, depth * 0.7, 0.1), "fabric"),
        Box(side * (width / 2 + 0.02), depth / 2, 0, (0.04, depth, rng.uniform(0.8, 1.0)), "wood"),
    )
    return Piece(width + 0.08, depth, boxes)


def cartons(rng: np.random.Generator) -> Piece:
    """A pile of moving boxes."""
    boxes, bottom, size = [], 0.0, rng.uniform(0.45, 0.6)
    for _ in range(rng.integers(2, 4)):
        height = size * rng.uniform(0.6, 0.8)
        boxes.append(Box(rng.uniform(-0.04, 0.04), 0.3, bottom, (size, size * 0.8, height), "carton"))
        bottom, size = bottom + height, size * rng.uniform(0.75, 0.95)
    return Piece(0.7, 0.6, tuple(boxes))


def chair(rng: np.random.Generator) -> Piece:
    """A chair: seat, four legs, back with two bars."""
    seat, back = rng.uniform(0.43, 0.48), rng.uniform(0.85, 1.0)
    boxes = [Box(0, 0.3, seat, (0.44, 0.42, 0.04), "fabric")]
    for x in (-0.19, 0.19):
        boxes += [Box(x, 0.11, 0, (0.04, 0.04, back), "wood"), Box(x, 0.48, 0, (0.04, 0.04, seat), "wood")]
    boxes += [Box(0, 0.11, z, (0.34, 0.02, 0.08), "wood") for z in (back - 0.1, back - 0.28)]
    return Piece(0.5, 0.55, tuple(boxes))


TALL: tuple[Maker, ...] = (wardrobe, bookshelf)
"""What stands in front of blocked overlaps."""

LOW: tuple[Maker, ...] = (bed, table, cartons, chair)
"""What leaves the cameras' height free."""
