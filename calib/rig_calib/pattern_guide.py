"""The page of a pattern set that explains how to print it and where to hang it."""

from math import cos, radians, sin

from fpdf import FPDF

from rig_calib.pattern_layout import PatternSet

_LEFT, _RIGHT, _TOP = 18.0, 192.0, 22.0
_INK, _GREY, _LINE = 25, 110, 150
_ACCENT, _VIEW = (196, 84, 20), (222, 230, 240)
_BODY_MM = 4.9

_HALF_VIEW_DEG, _MAX_STEP_DEG = 21.5, 30.0  # of an upright Kinect; the ring that its overlap allows
_HALF_HEIGHT_TAN = 0.54  # of half of its 57 degrees


def draw_guide(pdf: FPDF, plan: PatternSet) -> None:
    """Add the page, A4 whatever the sheets are."""
    pdf.add_page(format="A4")
    _draw_heading(pdf, plan)
    _draw_plan_view(pdf, plan, centre=(51.0, 80.0))
    _draw_side_view(pdf, plan, corner=(112.0, 47.0))
    y = 134.0
    for number, (head, text) in enumerate(_steps(plan), start=1):
        y = _draw_step(pdf, y, number, head, text)
    pdf.set_font("Helvetica", size=7.5)
    pdf.set_text_color(_GREY)
    pdf.text(_LEFT, 284, "Made by rig-calib pattern. The same seed and options make the same sheets again.")


def _steps(plan: PatternSet) -> list[tuple[str, str]]:
    """Head and text of every numbered paragraph."""
    heights = {None: "High and low", 1: "Some higher, some lower", 2: "One high and one low in each overlap"}
    where = heights.get(plan.per_overlap, "Low, middle and high in each overlap")
    share = f"{plan.patterns} patterns for {plan.overlaps} overlaps"
    share += "" if plan.per_overlap is None else f", {plan.per_overlap} for each"
    texts = {
        "Print at 100 %": (
            "No 'fit to page'. Matt paper; a grey laser print is enough. Measure the scale bar of one "
            "sheet: 100 mm, give or take 2 mm. (Depth gives the calibration its scale: the size need "
            "not be exact.)"
        ),
        "Hang them where two neighbours' views overlap": (
            f"That is half-way between two cameras, seen from the ring, 0.8 to 3 m away: {share}. "
            "Sheets elsewhere do no harm, and help little."
        ),
        "Use the whole height of the view": (
            f"{where}, never all in one row: matches along one line leave a direction undecided. "
            "Different distances within an overlap are better than one flat wall."
        ),
        "Flat, dull and still": (
            "Tape all corners; nothing behind glass, no glossy film, no lamp that mirrors in the "
            "print. Any surface will do: wall, door, wardrobe, a box in front of it."
        ),
        "Never two copies of a sheet": (
            "Equal sheets look equal to the matcher and spoil an edge. For more sheets, make another "
            f"set with another --seed (this is {plan.seed}); every id occurs once."
        ),
        "Calibrate": (
            "rig-server --calibrate, or rig-calib solve on a recorded folder. The report names "
            "overlaps that still lack support. Afterwards the sheets may come down; their places need "
            "not be known or kept."
        ),
    }
    steps = list(texts.items())
    if plan.columns * plan.rows > 1:
        steps.insert(1, ("Join the sheets of a pattern first", _joining(plan)))
    return steps


def _joining(plan: PatternSet) -> str:
    return (
        f"{plan.columns} across, {plan.rows} down. Cut off the left and top margins at the marks (not "
        "those of column 1, row 1), and glue each sheet over the strip of its left and upper "
        "neighbour, up to the marks."
    )


def _draw_heading(pdf: FPDF, plan: PatternSet) -> None:
    pdf.set_text_color(_INK)
    pdf.set_font("Helvetica", "B", 20)
    pdf.text(_LEFT, _TOP, "How to hang these patterns")
    pdf.set_font("Helvetica", size=10)
    pdf.set_text_color(_GREY)
    pdf.text(_LEFT, _TOP + 7, plan.summary)
    pdf.set_draw_color(_LINE)
    pdf.set_line_width(0.3)
    pdf.line(_LEFT, _TOP + 11, _RIGHT, _TOP + 11)


def _draw_step(pdf: FPDF, y: float, number: int, head: str, text: str) -> float:
    """One numbered paragraph; returns where the next begins."""
    pdf.set_fill_color(*_ACCENT)
    pdf.circle(_LEFT + 3.2, y - 1.4, 3.2, style="F")
    pdf.set_font("Helvetica", "B", 9)
    pdf.set_text_color(255)
    pdf.text(_LEFT + 3.2 - pdf.get_string_width(str(number)) / 2, y - 0.2, str(number))
    pdf.set_text_color(_INK)
    pdf.set_font("Helvetica", "B", 11)
    pdf.text(_LEFT + 10, y, head)
    pdf.set_font("Helvetica", size=9.5)
    pdf.set_xy(_LEFT + 9, y + 1.8)
    pdf.multi_cell(_RIGHT - _LEFT - 9, _BODY_MM, text, align="L")
    return float(pdf.get_y()) + 7.4


def _draw_plan_view(pdf: FPDF, plan: PatternSet, centre: tuple[float, float]) -> None:
    """The ring from above in a room: overlaps, and a sheet on the wall in each of them."""
    half, ring = 33.0, 4.4
    _caption(pdf, centre[0] - half, centre[1] - half - 3.5, "From above")
    step = min(360.0 / plan.cameras, _MAX_STEP_DEG)
    overlaps = [step * i for i in range(plan.overlaps)]
    pdf.set_fill_color(*_VIEW)
    for azimuth in overlaps:
        side = _HALF_VIEW_DEG - step / 2
        on_wall = [_on_wall(centre, azimuth + turn, half) for turn in (-side, 0, side)]
        pdf.polygon([centre, *on_wall], style="F")
    pdf.set_draw_color(_LINE)
    pdf.set_line_width(0.8)
    pdf.rect(centre[0] - half, centre[1] - half, 2 * half, 2 * half, style="D")
    pdf.set_draw_color(*_ACCENT)
    pdf.set_line_width(1.5)
    for azimuth in overlaps:
        pdf.line(*_on_wall(centre, azimuth - 4, half - 1.4), *_on_wall(centre, azimuth + 4, half - 1.4))
    pdf.set_draw_color(_INK)
    pdf.set_line_width(0.4)
    pdf.set_fill_color(255)
    pdf.circle(*centre, ring, style="DF")
    pdf.set_fill_color(_INK)
    for camera in range(plan.cameras):
        pdf.circle(*_polar(centre, step * (camera - 0.5), ring), 0.75, style="F")
    _draw_legend(pdf, centre[0] - half, centre[1] + half + 5.5)


def _draw_legend(pdf: FPDF, x: float, y: float) -> None:
    pdf.set_font("Helvetica", size=8)
    pdf.set_text_color(_GREY)
    pdf.set_fill_color(*_VIEW)
    pdf.rect(x, y - 2.4, 5, 3, style="F")
    pdf.text(x + 6.5, y, "both neighbours look here")
    pdf.set_fill_color(*_ACCENT)
    pdf.rect(x + 45, y - 1.7, 5, 1.5, style="F")
    pdf.text(x + 51.5, y, "pattern")


def _draw_side_view(pdf: FPDF, plan: PatternSet, corner: tuple[float, float]) -> None:
    """Rig and wall from the side: the view's height and the sheets that fill it."""
    width, height = 80.0, 66.0
    x, y = corner
    _caption(pdf, x, y - 3.5, "From the side")
    floor, eye, wall = y + height, (x + 12.0, y + 32.0), x + width - 4.0
    reach = (wall - eye[0]) * _HALF_HEIGHT_TAN
    pdf.set_fill_color(*_VIEW)
    pdf.polygon([eye, (wall, eye[1] - reach), (wall, min(eye[1] + reach, floor))], style="F")
    pdf.set_draw_color(_LINE)
    pdf.set_line_width(0.8)
    pdf.line(x, floor, x + width, floor)
    pdf.line(wall, y - 2, wall, floor)
    pdf.set_draw_color(_INK)
    pdf.set_line_width(0.5)
    pdf.line(eye[0] - 2.5, eye[1] + 3, eye[0] - 2.5, floor)
    pdf.set_fill_color(_INK)
    pdf.rect(eye[0] - 4, eye[1] - 5.5, 4, 11, style="F")
    count = min(4, plan.per_overlap or 1)
    tall = min(plan.size_mm[1] / 2200 * 2 * reach, 1.8 * reach / count - 1.5)
    pdf.set_fill_color(*_ACCENT)
    for k in range(count):
        middle = eye[1] + ((k + 0.5) / count - 0.5) * 1.8 * reach
        pdf.rect(wall - 1.9, middle - tall / 2, 1.5, tall, style="F")
    _draw_distance(pdf, eye[0], wall, floor - 6.0, "0.8 - 3 m")


def _draw_distance(pdf: FPDF, x1: float, x2: float, y: float, text: str) -> None:
    pdf.set_draw_color(_GREY)
    pdf.set_line_width(0.2)
    pdf.line(x1, y, x2, y)
    for x in (x1, x2):
        pdf.line(x, y - 1.2, x, y + 1.2)
    pdf.set_font("Helvetica", size=8)
    pdf.set_text_color(_GREY)
    pdf.text((x1 + x2 - pdf.get_string_width(text)) / 2, y - 1.4, text)


def _caption(pdf: FPDF, x: float, y: float, text: str) -> None:
    pdf.set_font("Helvetica", "B", 9.5)
    pdf.set_text_color(_INK)
    pdf.text(x, y, text)


def _polar(centre: tuple[float, float], azimuth_deg: float, radius: float) -> tuple[float, float]:
    angle = radians(azimuth_deg)
    return centre[0] + radius * cos(angle), centre[1] - radius * sin(angle)


def _on_wall(centre: tuple[float, float], azimuth_deg: float, half: float) -> tuple[float, float]:
    """Where a ray from the centre of a square meets it."""
    angle = radians(azimuth_deg)
    return _polar(centre, azimuth_deg, half / max(abs(cos(angle)), abs(sin(angle))))
