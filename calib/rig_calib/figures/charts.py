"""Charts as inline SVG: they scale, need no scripts and take their colours from the page's CSS.

Classes that the page styles: `good`, `bad`, `ink`, `faint`, `fill-good`, `fill-bad`, `label`.
"""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def svg(width: float, height: float, description: str, parts: Sequence[str]) -> str:
    """An SVG image of `parts` with a description for those who cannot see it."""
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(description)}" '
        f'style="max-width:{width:g}px">{"".join(parts)}</svg>'
    )


def text(x: float, y: float, content: str, anchor: str = "start") -> str:
    """A label; `anchor` is start, middle or end."""
    return f'<text class="label" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(content)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, css: str) -> str:
    """A straight line of a CSS class."""
    return f'<line class="{css}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def rectangle(x: float, y: float, width: float, height: float, css: str) -> str:
    """A filled rectangle of a CSS class; nothing when it has no area."""
    if width <= 0 or height <= 0:
        return ""
    return f'<rect class="{css}" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'


def polygon(points: Array, css: str) -> str:
    """A closed polygon through points (N,2)."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polygon class="{css}" points="{path}"/>'


def ellipse(centre: Array, covariance: Array, sigmas: float, css: str) -> str:
    """The contour of a 2-D normal distribution (2,2) at so many standard deviations."""
    variances, axes = np.linalg.eigh(covariance)
    radii = sigmas * np.sqrt(np.maximum(variances, 0.0))
    angle = np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1]))
    return (
        f'<ellipse class="{css}" rx="{radii[1]:.2f}" ry="{radii[0]:.2f}" '
        f'transform="translate({centre[0]:.1f} {centre[1]:.1f}) rotate({angle:.1f})"/>'
    )


def histogram(
    good: Array, bad: Array, limit: float, unit: str, title: str, width: int = 420, height: int = 200
) -> str:
    """Counts of good and bad values between 0 and `limit`, larger ones in the last bin, stacked."""
    bins = np.linspace(0.0, limit, 31)
    counts_good = np.histogram(np.minimum(good, limit), bins)[0]
    counts_bad = np.histogram(np.minimum(bad, limit), bins)[0]
    top = max(1, int((counts_good + counts_bad).max()))
    left, right, base, head = 40, 12, height - 34, 22
    step, scale = (width - left - right) / (len(bins) - 1), (base - head) / top
    parts = [text(left, 14, title)]
    for k, (g, b) in enumerate(zip(counts_good, counts_bad, strict=True)):
        x = left + k * step
        parts.append(rectangle(x + 0.5, base - g * scale, step - 1, g * scale, "fill-good"))
        parts.append(rectangle(x + 0.5, base - (g + b) * scale, step - 1, b * scale, "fill-bad"))
    parts.append(line(left, base, width - right, base, "ink"))
    for fraction in (0.0, 0.5, 1.0):
        x = left + fraction * (width - left - right)
        more = "≥ " if fraction == 1.0 else ""
        parts.append(text(x, base + 16, f"{more}{fraction * limit:.3g}", "end" if more else "middle"))
    parts.append(text((left + width - right) / 2, base + 31, unit, "middle"))
    parts.append(text(left - 6, head + 8, str(top), "end"))
    parts.append(text(left - 6, base, "0", "end"))
    median = f", median {np.median(good):.2f} {unit}" if len(good) else ""
    return svg(width, height, f"{title}: {len(good)} kept{median}; {len(bad)} rejected", parts)


def horizontal_bars(values: Mapping[str, float], unit: str, description: str, width: int = 560) -> str:
    """One bar a value, labelled with name and number."""
    row, left, right = 24, 120, 70
    top = max([*values.values(), 1e-9])
    parts: list[str] = []
    for k, (name, value) in enumerate(values.items()):
        y = k * row
        length = max(value, 0.0) / top * (width - left - right)
        parts.append(text(left - 8, y + 16, name, "end"))
        parts.append(rectangle(left, y + 4, max(length, 1.0), row - 8, "fill-good"))
        parts.append(text(left + length + 6, y + 16, f"{value:.2f} {unit}"))
    return svg(width, row * max(len(values), 1), description, parts)
