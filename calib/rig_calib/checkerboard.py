"""Checkerboards: where their inner corners are on the board and in an image."""

import re
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.errors import ConfigurationError

Array = npt.NDArray[np.float64]

_PATTERN = re.compile(r"(\d{1,3})[x×](\d{1,3})")
_SUBPIXEL_WINDOW = (5, 5)
_SUBPIXEL_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)


@dataclass(frozen=True, slots=True)
class Board:
    """A checkerboard of `columns` × `rows` inner corners, its squares `square_m` wide."""

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        """ConfigurationError for a board that calibrates nothing."""
        if min(self.columns, self.rows) < 3 or self.columns == self.rows or not 0 < self.square_m < 1:
            raise ConfigurationError(
                f"a board of {self.columns}×{self.rows} inner corners and {self.square_m * 1e3:g} mm squares "
                "cannot be used: it needs three corners or more each way, not as many in both, "
                "and squares of less than a metre"
            )

    @classmethod
    def parse(cls, text: str, square_mm: float) -> "Board":
        """The board of `9x6`: inner corners across and down; ConfigurationError for other text."""
        match = _PATTERN.fullmatch(text.strip().lower())
        if match is None:
            raise ConfigurationError(f"board {text!r} is not of the form 9x6 (inner corners across × down)")
        return cls(int(match.group(1)), int(match.group(2)), square_mm * 1e-3)

    def corners_m(self) -> Array:
        """Corners (N,3) on the board, row after row, z = 0."""
        grid = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) * self.square_m
        return np.column_stack([grid, np.zeros(len(grid))])

    def find(self, image: npt.NDArray[np.uint8]) -> Array | None:
        """Corners (N,2) in an image, sub-pixel, in the order of `corners_m`; None when there is no board."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(grey, (self.columns, self.rows), flags=flags)
        if not found:
            return None
        refined = cv2.cornerSubPix(grey, corners, _SUBPIXEL_WINDOW, (-1, -1), _SUBPIXEL_STOP)
        return np.asarray(refined, dtype=np.float64).reshape(-1, 2)
