"""Small SVG pictures for the pages under docs/: the same figures give the same file."""

from collections.abc import Callable

import matplotlib as mpl

mpl.use("svg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from support.benchmark_record import REPOSITORY

IMAGES = REPOSITORY / "docs" / "images"
_STYLE = {
    "svg.hashsalt": "kinect-rig",
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.constrained_layout.use": True,
}


def picture(name: str, inches: tuple[float, float], draw: Callable[[Axes], None]) -> None:
    """Draw docs/images/`name`.svg, without a date."""
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]  # a plain dict of settings
        figure, axes = plt.subplots(figsize=inches)
        draw(axes)
        IMAGES.mkdir(exist_ok=True)
        figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None})
        plt.close(figure)
