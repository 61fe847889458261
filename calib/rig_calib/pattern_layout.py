"""What a set of printed patterns consists of: paper, sheets, and which part of a pattern each shows."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from typing import Any

from rig_calib.pattern import CELLS_MM
from rig_protocol.errors import ConfigurationError

Size = tuple[float, float]
"""Width and height, mm."""

PAPERS_MM: dict[str, Size] = {
    "A4": (210, 297),
    "A3": (297, 420),
    "A2": (420, 594),
    "A1": (594, 841),
    "A0": (841, 1189),
}
PIXEL_MM = 0.5  # a third of what a Kinect's pixel covers at 0.8 m
MARGIN_MM = 10.0  # more than what printers leave white
FOOTER_MM = 14.0
GLUE_MM = 10.0  # tiles share a strip of this width
SCALE_BAR_MM = 100.0

_COVERED_HEIGHT_MM = 1300  # of the 2.2 m that two neighbours share at two metres
_MAX_SIDE_MM = 3000  # beyond, a raster fills the memory, and several patterns serve better
_MAX_AREA_M2 = 100  # of all patterns of a file, which is made in memory
_FULL_CIRCLE = 12
_PAIR = re.compile(r"(\d+(?:\.\d+)?)\s*[x×]\s*(\d+(?:\.\d+)?)")


@dataclass(frozen=True, slots=True)
class Sheet:
    """One printed sheet: its place in its pattern (from 1) and the part that it shows."""

    pattern: int
    row: int
    column: int
    corner_mm: Size
    size_mm: Size


@dataclass(frozen=True, slots=True)
class PatternSet:
    """`patterns` different patterns of one seed, each on `columns` × `rows` sheets of paper."""

    seed: int
    patterns: int
    paper: str
    columns: int
    rows: int
    size_mm: Size
    cameras: int

    def sheets(self, pattern: int) -> Iterator[Sheet]:
        """The sheets of a pattern, row after row."""
        step = _step(self.paper)
        for row in range(self.rows):
            for column in range(self.columns):
                corner = (column * step[0], row * step[1])
                shown = (
                    min(step[0] + GLUE_MM, self.size_mm[0] - corner[0]),
                    min(step[1] + GLUE_MM, self.size_mm[1] - corner[1]),
                )
                yield Sheet(pattern, row + 1, column + 1, corner, shown)

    @property
    def sheet_count(self) -> int:
        """Sheets of paper in all."""
        return self.patterns * self.rows * self.columns

    @property
    def overlaps(self) -> int:
        """Pairs of neighbours that share a view."""
        return _overlaps(self.cameras)

    @property
    def per_overlap(self) -> int | None:
        """Patterns for each overlap; None where they do not come out even."""
        return None if self.patterns % self.overlaps else self.patterns // self.overlaps

    @property
    def summary(self) -> str:
        """What the set is, in a sentence's first half."""
        tiled = self.sheet_count // self.patterns
        width, height = (f"{side / 10:.0f}" for side in self.size_mm)
        each = self.per_overlap
        share = "" if each is None else f", {each} for each of {self.overlaps} overlaps"
        return (
            f"{self.patterns} different patterns of {width} × {height} cm, seed {self.seed}, on "
            f"{self.sheet_count} sheets of {self.paper}{f' ({tiled} a pattern)' if tiled > 1 else ''}{share}"
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Raster of one pattern: rows, columns."""
        return round(self.size_mm[1] / PIXEL_MM), round(self.size_mm[0] / PIXEL_MM)

    def pattern_id(self, pattern: int) -> str:
        """What is printed on every sheet of a pattern, as 42-07."""
        return f"{self.seed}-{pattern:02d}"

    def sheet_id(self, sheet: Sheet) -> str:
        """The pattern's id, and for one of several sheets its row and column, as 42-07 r1c2."""
        tiled = self.rows * self.columns > 1
        return self.pattern_id(sheet.pattern) + (f" r{sheet.row}c{sheet.column}" if tiled else "")

    def to_dict(self, digests: dict[int, str]) -> dict[str, Any]:
        """The content of patterns.json; `digests`: SHA-256 of the raster of each pattern."""
        return {
            "schema": 1,
            "seed": self.seed,
            "paper": self.paper,
            "cameras": self.cameras,
            "tiles": {"columns": self.columns, "rows": self.rows, "overlap_mm": GLUE_MM},
            "size_mm": list(self.size_mm),
            "pixel_mm": PIXEL_MM,
            "octave_cells_mm": list(CELLS_MM),
            "scale_bar_mm": SCALE_BAR_MM,
            "patterns": [
                {
                    "id": self.pattern_id(pattern),
                    "pattern": pattern,
                    "raster_sha256": digests[pattern],
                    "sheets": [self._sheet_dict(sheet) for sheet in self.sheets(pattern)],
                }
                for pattern in range(1, self.patterns + 1)
            ],
        }

    def _sheet_dict(self, sheet: Sheet) -> dict[str, Any]:
        before = (sheet.pattern - 1) * self.rows * self.columns
        page = 2 + before + (sheet.row - 1) * self.columns + sheet.column - 1  # page 1 explains
        return {
            "id": self.sheet_id(sheet),
            "page": page,
            "row": sheet.row,
            "column": sheet.column,
            "corner_mm": list(sheet.corner_mm),
            "size_mm": list(sheet.size_mm),
        }


def plan_patterns(
    paper: str,
    seed: int,
    cameras: int,
    patterns: int | None = None,
    tiles: str | None = None,
    size_m: str | None = None,
) -> PatternSet:
    """A set of patterns for a ring; by default as many as cover 1.3 m of the height of every overlap.

    `tiles` as 3x4 (columns, rows) or `size_m` as 0.9x1.2 (width, height) spread one pattern over several
    sheets. ConfigurationError says what cannot be printed.
    """
    paper = paper.upper()
    if paper not in PAPERS_MM:
        raise ConfigurationError(f"paper {paper} is none of {', '.join(PAPERS_MM)}")
    if tiles is not None and size_m is not None:
        raise ConfigurationError("--tiles and --size-m say the same thing twice: give one of them")
    columns, rows, size_mm = _tiling(paper, tiles, size_m)
    if max(size_mm) > _MAX_SIDE_MM:
        raise ConfigurationError(
            f"a pattern of {size_mm[0] / 1e3:.2f} m × {size_mm[1] / 1e3:.2f} m is too large (at most 3 m a "
            "side): hang several smaller ones side by side"
        )
    if patterns is None:
        patterns = _overlaps(cameras) * max(1, min(4, round(_COVERED_HEIGHT_MM / size_mm[1])))
    area_m2 = patterns * size_mm[0] * size_mm[1] / 1e6
    if patterns < 1 or area_m2 > _MAX_AREA_M2:
        raise ConfigurationError(
            f"{patterns} patterns are {area_m2:.0f} m²; one file holds 1 pattern to {_MAX_AREA_M2} m²: "
            "make fewer, or several sets with different seeds"
        )
    return PatternSet(seed, patterns, paper, columns, rows, size_mm, cameras)


def _overlaps(cameras: int) -> int:
    """Twelve upright Kinects close the circle; fewer make an open arc."""
    return cameras if cameras >= _FULL_CIRCLE else max(1, cameras - 1)


def _tiling(paper: str, tiles: str | None, size_m: str | None) -> tuple[int, int, Size]:
    """Columns, rows and size of a pattern."""
    step = _step(paper)
    if size_m is not None:
        pixels = [round(side * 1e3 / PIXEL_MM) for side in _pair(size_m, "--size-m", "0.9x1.2")]
        width, height = (count * PIXEL_MM for count in pixels)
        if min(width, height) < SCALE_BAR_MM:
            raise ConfigurationError(f"--size-m {size_m} is in metres, and at least 0.1 each way")
        columns, rows = ceil((width - GLUE_MM) / step[0]), ceil((height - GLUE_MM) / step[1])
        return columns, rows, (width, height)
    columns, rows = (1, 1) if tiles is None else (int(n) for n in _pair(tiles, "--tiles", "3x4"))
    if not (1 <= columns <= 99 and 1 <= rows <= 99):
        raise ConfigurationError(f"--tiles {tiles}: give 1 to 99 columns and rows")
    return columns, rows, (columns * step[0] + GLUE_MM, rows * step[1] + GLUE_MM)


def _pair(text: str, option: str, example: str) -> tuple[float, float]:
    match = _PAIR.fullmatch(text.strip().lower())
    if match is None or (option == "--tiles" and "." in text):
        raise ConfigurationError(f"{option} {text!r} is not of the form {example} (across × down)")
    return float(match.group(1)), float(match.group(2))


def _step(paper: str) -> Size:
    """By how much the parts of neighbouring sheets are apart."""
    width, height = PAPERS_MM[paper]
    return width - 2 * MARGIN_MM - GLUE_MM, height - 2 * MARGIN_MM - FOOTER_MM - GLUE_MM
