"""Charts as inline SVG: they scale, need no scripts and take their colours from the page's CSS.

Classes that the page styles: `ink`, `faint`, `curve`, `fill-good`, `fill-bad`, `fill-step-0` … `-3`, `label`.
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


def text(x: float, y: float, content: str, anchor: str = "start", css: str = "label") -> str:
    """A label of a CSS class; `anchor` is start, middle or end."""
    return f'<text class="{css}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(content)}</text>'


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


def normal_histogram(values: Array, title: str, width: int = 300, height: int = 150) -> str:
    """Standardised values (N,) against the standard normal curve, with their robust spread in the title."""
    limit, left, right, base, head = 4.0, 8, 8, height - 20, 20
    bins = np.linspace(-limit, limit, 41)
    counts = np.histogram(np.clip(values, -limit, limit), bins)[0]
    expected = len(values) * (bins[1] - bins[0]) * np.exp(-0.5 * bins**2) / np.sqrt(2 * np.pi)
    scale = (base - head) / max(float(counts.max()), float(expected.max()), 1.0)
    step = (width - left - right) / (len(bins) - 1)
    parts = [text(left, 13, title), text(width - right, 13, f"spread {robust_spread(values):.2f}", "end")]
    parts += [
        rectangle(left + k * step + 0.5, base - count * scale, step - 1, count * scale, "fill-good")
        for k, count in enumerate(counts)
    ]
    points = " ".join(f"{left + k * step:.1f},{base - e * scale:.1f}" for k, e in enumerate(expected))
    parts.append(f'<polyline class="curve" points="{points}"/>')
    parts.append(line(left, base, width - right, base, "ink"))
    for value in (-4, -2, 0, 2, 4):
        x = left + (value + limit) / (2 * limit) * (width - left - right)
        parts.append(text(x, base + 15, f"{value:d}".replace("-", "−"), _anchor(value, limit)))
    return svg(width, height, f"{title}: {len(values)} values, spread {robust_spread(values):.2f}", parts)


def robust_spread(values: Array) -> float:
    """Standard deviation (0 of nothing) that the median absolute value gives; outliers hardly change it."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def grouped_bars(
    groups: Mapping[tuple[str, str], Sequence[float]],
    series: Sequence[str],
    unit: str,
    description: str,
    highlight: tuple[str, str] | None = None,
) -> str:
    """A group of bars for each label (two lines), one bar a series, the top of the last one in numbers."""
    left, head, chart, foot = 44.0, 30.0, 190.0, 40.0
    bar = 13.0 if len(groups) <= 16 else 7.0
    step = bar * len(series) + 18.0
    width, base = left + step * len(groups), head + chart
    top = nice_ceiling(max([max(values) for values in groups.values()], default=1.0))
    parts = [text(left - 6, 14, unit, "end")]
    for share in (0.0, 0.5, 1.0):
        y = base - share * chart
        parts.append(line(left, y, width, y, "faint" if share else "ink"))
        parts.append(text(left - 6, y + 4, f"{share * top:g}", "end"))
    for k, (labels, values) in enumerate(groups.items()):
        heights = [min(value / top, 1.0) * chart for value in values]
        css = "label worst" if labels == highlight else "label"
        parts += _bar_group(left + k * step + 9, base, bar, heights, labels, css)
        last = left + (k + 1) * step - 9 - bar / 2
        parts.append(text(last, base - heights[-1] - 5, f"{values[-1]:.1f}", "middle", css))
    for k, name in enumerate(series):
        x = left + 9 + 58 * k
        parts += [rectangle(x, 4, 11, 11, f"fill-step-{k}"), text(x + 16, 14, name)]
    return svg(width, base + foot, description, parts)


def _bar_group(
    x: float, base: float, bar: float, heights: Sequence[float], labels: Sequence[str], css: str
) -> list[str]:
    """Bars that stand side by side on `base`, their labels line by line below."""
    parts = [
        rectangle(x + k * bar, base - height, bar - 1.5, height, f"fill-step-{k}")
        for k, height in enumerate(heights)
    ]
    middle = x + bar * len(heights) / 2
    rows = enumerate(labels)
    return parts + [text(middle, base + 16 + 14 * row, label, "middle", css) for row, label in rows]


def nice_ceiling(value: float) -> float:
    """The least of 1, 2, 3, 5, 8 times a power of ten that is not below a value."""
    if not 0 < value < np.inf:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next((m * decade for m in (1, 2, 3, 5, 8) if m * decade >= value), 10.0 * decade))


def _anchor(value: float, limit: float) -> str:
    return "start" if value == -limit else "end" if value == limit else "middle"


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
