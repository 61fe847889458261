"""Procedural surfaces: descriptor patterns and what a furnished room is made of.

A painter takes a generator, the texture's shape (rows, columns) and the size of a texel in metres, and
returns reflectance (rows, columns, 3) BGR, f32, 0..1.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import numpy.typing as npt

Texture = npt.NDArray[np.float32]
Shape = tuple[int, int]
Painter = Callable[[np.random.Generator, Shape, float], Texture]

# Cells of the pattern's octaves: from a pixel and a half at two metres to half of a panel.
_PATTERN_CELLS_M = tuple(0.01 * 2**k for k in range(6))
_PATTERN_BORDER_M = 0.02


def octave_noise(rng: np.random.Generator, shape: Shape, cells: Sequence[tuple[float, float]]) -> Texture:
    """Noise (rows, columns), f32, std about 1: octaves of equal energy; cells (row, column) in texels."""
    total = np.zeros(shape, np.float32)
    for rows, columns in cells:
        grid_shape = (int(shape[0] / max(rows, 1.0)) + 2, int(shape[1] / max(columns, 1.0)) + 2)
        grid = rng.standard_normal(grid_shape, dtype=np.float32)
        octave = np.asarray(cv2.resize(grid, shape[::-1], interpolation=cv2.INTER_CUBIC), dtype=np.float32)
        total += octave / max(float(octave.std()), 1e-6)
    return np.asarray(total / np.sqrt(len(cells)), dtype=np.float32)


def pattern(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """A descriptor pattern: multi-scale noise printed nearly black on tinted paper with a plain border."""
    cells = [(cell / texel_m, cell / texel_m) for cell in _PATTERN_CELLS_M]
    ink = 0.5 + 0.5 * np.tanh(1.4 * octave_noise(rng, shape, cells))
    paper = np.array([0.86, 0.88, 0.9]) + rng.uniform(-0.08, 0.08, 3)
    image = _tint(0.07 + 0.93 * ink, paper)
    border = max(1, round(_PATTERN_BORDER_M / texel_m))
    for edge in (image[:border], image[-border:], image[:, :border], image[:, -border:]):
        edge[...] = paper
    return image


def paint(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """Painted plaster: nearly plain."""
    base = np.array([0.66, 0.70, 0.74]) + rng.uniform(-0.05, 0.05, 3)
    return _tint(1 + 0.02 * octave_noise(rng, shape, _cells(texel_m, 0.03, 0.12, 0.5)), base)


def planks(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """A wooden floor: planks of slightly different shade, weak grain, dark joints."""
    width = max(4, round(0.14 / texel_m))
    shades = np.repeat(1 + 0.06 * rng.standard_normal(shape[0] // width + 1), width)[: shape[0]]
    grain = octave_noise(rng, shape, [(2.0, 40.0), (4.0, 120.0), (8.0, 200.0)])
    image = _tint(shades[:, None] * (1 + 0.05 * grain), np.array([0.32, 0.45, 0.58]))
    image[::width] *= 0.6
    return image


def carpet(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """A carpet: fine pile, soft stains."""
    base = np.array([0.42, 0.40, 0.44]) + rng.uniform(-0.06, 0.06, 3)
    return _tint(1 + 0.07 * octave_noise(rng, shape, _cells(texel_m, 0.008, 0.02, 0.3)), base)


def wood(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """Veneer: weak stretched grain along the columns' direction."""
    fine, coarse = 0.006 / texel_m, 0.03 / texel_m
    grain = octave_noise(rng, shape, [(30 * fine, fine), (12 * coarse, coarse)])
    base = np.array([0.22, 0.36, 0.52]) * rng.uniform(0.8, 1.25)
    return _tint(1 + 0.10 * grain, base)


def fabric(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """A blanket: weave and soft folds."""
    base = rng.uniform(0.2, 0.6, 3)
    return _tint(1 + 0.07 * octave_noise(rng, shape, _cells(texel_m, 0.008, 0.06, 0.25)), base)


def carton(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """Cardboard with a strip of tape."""
    image = _tint(
        1 + 0.04 * octave_noise(rng, shape, _cells(texel_m, 0.01, 0.08)), np.array([0.36, 0.5, 0.64])
    )
    half = max(1, round(0.03 / texel_m))
    image[:, shape[1] // 2 - half : shape[1] // 2 + half] *= 0.85
    return image


def books(rng: np.random.Generator, shape: Shape, texel_m: float) -> Texture:
    """A row of book spines of different colours, with a label each."""
    image = np.zeros((*shape, 3), np.float32)
    column = 0
    while column < shape[1]:
        spine = image[:, column : column + max(2, round(rng.uniform(0.015, 0.05) / texel_m))]
        spine[...] = rng.uniform(0.1, 0.7, 3)
        label = slice(int(shape[0] * rng.uniform(0.15, 0.4)), int(shape[0] * rng.uniform(0.45, 0.7)))
        spine[label] += 0.2
        spine[:, 0] *= 0.4
        column += spine.shape[1]
    return image


PAINTERS: dict[str, Painter] = {
    painter.__name__: painter for painter in (pattern, paint, planks, carpet, wood, fabric, carton, books)
}


def _cells(texel_m: float, *sizes_m: float) -> list[tuple[float, float]]:
    return [(size / texel_m, size / texel_m) for size in sizes_m]


def _tint(shade: npt.NDArray[np.floating], base: npt.NDArray[np.float64]) -> Texture:
    """Reflectance (rows, columns, 3) of a shade (rows, columns) of one colour."""
    return np.asarray(np.clip(shade[..., None] * base.astype(np.float32), 0.02, 0.98), dtype=np.float32)
