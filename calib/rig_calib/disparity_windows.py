"""Small windows of a disparity image around given places: medians, and planes fitted to them; compiled."""

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled, inlined

Array = npt.NDArray[np.float64]

_FAR = 1e6
"""Places beyond it, and those that are NaN, have no pixels."""


@compiled()
def window_medians(disparity: Array, at: Array) -> Array:
    """Median (N,) of what is known in 3×3 pixels around places (N,2), column and row; NaN for nothing."""
    height, width = disparity.shape
    known, out = np.empty(9), np.full(len(at), np.nan)
    for k in range(len(at)):
        if not (abs(at[k, 0]) < _FAR and abs(at[k, 1]) < _FAR):
            continue
        count, column, row = 0, round(at[k, 0]), round(at[k, 1])
        for v in range(max(row - 1, 0), min(row + 2, height)):
            for u in range(max(column - 1, 0), min(column + 2, width)):
                if np.isfinite(disparity[v, u]):
                    place = count  # insertion into what is sorted so far
                    while place > 0 and known[place - 1] > disparity[v, u]:
                        known[place] = known[place - 1]
                        place -= 1
                    known[place] = disparity[v, u]
                    count += 1
        if count:
            out[k] = 0.5 * (known[(count - 1) // 2] + known[count // 2])
    return out


@inlined
def _plane(
    disparity: Array, rows: tuple[int, int], columns: tuple[int, int], u0: float, v0: float, needed: float
) -> tuple[float, float, float]:
    """Least-squares (a, b, c) of d = a + b (u − u0) + c (v − v0) over a window; NaN if little is known."""
    n, x_sum, y_sum, d_sum, base = 0, 0.0, 0.0, 0.0, np.nan
    xx, xy, yy, xd, yd = 0.0, 0.0, 0.0, 0.0, 0.0
    for v in range(rows[0], rows[1]):
        for u in range(columns[0], columns[1]):
            if np.isfinite(disparity[v, u]):
                if n == 0:
                    base = disparity[v, u]  # near all the others: sums of squares keep their digits
                x, y, d = u - u0, v - v0, disparity[v, u] - base
                n += 1
                x_sum, y_sum, d_sum = x_sum + x, y_sum + y, d_sum + d
                xx, xy, yy, xd, yd = xx + x * x, xy + x * y, yy + y * y, xd + x * d, yd + y * d
    x_mean, y_mean, d_mean = x_sum / n, y_sum / n, d_sum / n
    xx, xy, yy = xx - n * x_mean**2, xy - n * x_mean * y_mean, yy - n * y_mean**2
    xd, yd = xd - n * x_mean * d_mean, yd - n * y_mean * d_mean
    determinant = xx * yy - xy * xy
    if n < needed or not determinant > 1e-9 * xx * yy:
        return np.nan, np.nan, np.nan
    b, c = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
    return base + d_mean - b * x_mean - c * y_mean, b, c


@inlined
def _misfit(
    disparity: Array,
    rows: tuple[int, int],
    columns: tuple[int, int],
    u0: float,
    v0: float,
    plane: tuple[float, float, float],
) -> tuple[float, float]:
    """RMS and largest residual of a window's known pixels."""
    n, squares, worst = 0, 0.0, 0.0
    for v in range(rows[0], rows[1]):
        for u in range(columns[0], columns[1]):
            if np.isfinite(disparity[v, u]):
                residual = disparity[v, u] - (plane[0] + plane[1] * (u - u0) + plane[2] * (v - v0))
                n += 1
                squares += residual**2
                worst = max(worst, abs(residual))
    return np.sqrt(squares / n), worst


@compiled()
def fitted_planes(
    disparity: Array, at: Array, half: int, min_filled: float, max_rms: float, max_worst: float, planes: Array
) -> None:
    """Fill `planes` (N,3), where NaN, with the least-squares d = a + b·Δcolumn + c·Δrow around places.

    A window of (2·half + 1)² pixels around a place (N,2) counts when at least the share `min_filled` of it is
    known and no residual, and not their RMS, is larger than what is said.
    """
    height, width = disparity.shape
    needed = min_filled * (2 * half + 1) ** 2
    for k in range(len(at)):
        u0, v0 = at[k, 0], at[k, 1]
        if not np.isnan(planes[k, 0]) or not (abs(u0) < _FAR and abs(v0) < _FAR):
            continue
        column, row = round(u0), round(v0)
        rows = max(row - half, 0), min(row + half + 1, height)
        columns = max(column - half, 0), min(column + half + 1, width)
        plane = _plane(disparity, rows, columns, u0, v0, needed)
        if np.isnan(plane[0]):
            continue
        rms, worst = _misfit(disparity, rows, columns, u0, v0, plane)
        if rms < max_rms and worst < max_worst:
            planes[k, 0], planes[k, 1], planes[k, 2] = plane
