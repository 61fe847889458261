"""Pattern sheets at true print size as PDF: each with margins, its id, a scale bar and marks to trim by."""

import hashlib
import json
from collections.abc import Callable
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

from fpdf import FPDF
from PIL import Image

from rig_calib.pattern import descriptor_pattern
from rig_calib.pattern_guide import draw_guide
from rig_calib.pattern_layout import (
    GLUE_MM,
    MARGIN_MM,
    PAPERS_MM,
    PIXEL_MM,
    SCALE_BAR_MM,
    PatternSet,
    Sheet,
)
from rig_calib.whole_file import whole_file
from rig_protocol.frames import ImageU8

_GREY, _BLACK = 110, 0
_BAR_HEIGHT_MM, _BAR_STEP_MM = 2.4, 10.0
_MARK_MM, _MARK_GAP_MM = 4.0, 1.0
_OVER = "goes over this strip, to the marks"
_SAME_DATE = datetime(2000, 1, 1, tzinfo=UTC)  # the same set is the same file, whenever it is made


def pattern_pdf(
    plan: PatternSet, progress: Callable[[float], None] | None = None
) -> tuple[bytes, dict[int, str]]:
    """The PDF of a set, a page that explains first, and the SHA-256 of every pattern's raster."""
    pdf = FPDF(unit="mm", format="A4")
    pdf.set_auto_page_break(False)
    pdf.set_margin(0)
    pdf.set_creation_date(_SAME_DATE)
    pdf.set_title(f"Descriptor patterns, seed {plan.seed}")
    pdf.set_creator("rig-calib pattern")
    draw_guide(pdf, plan)
    digests = {}
    for pattern in range(1, plan.patterns + 1):
        raster = descriptor_pattern(plan.seed, pattern, plan.shape, PIXEL_MM)
        digests[pattern] = hashlib.sha256(raster.tobytes()).hexdigest()
        for sheet in plan.sheets(pattern):
            _draw_sheet(pdf, plan, sheet, raster)
        if progress is not None:
            progress(pattern / plan.patterns)
    return bytes(pdf.output()), digests


def write_pattern_set(
    folder: Path, plan: PatternSet, progress: Callable[[float], None] | None = None
) -> tuple[Path, Path]:
    """Write patterns.pdf and patterns.json into a folder that exists; RigError when it is full."""
    document, digests = pattern_pdf(plan, progress)
    sheets, record = folder / "patterns.pdf", folder / "patterns.json"
    with whole_file(sheets) as file:
        file.write(document)
    with whole_file(record) as file:
        file.write(json.dumps(plan.to_dict(digests), indent=1).encode() + b"\n")
    return sheets, record


def _draw_sheet(pdf: FPDF, plan: PatternSet, sheet: Sheet, raster: ImageU8) -> None:
    pdf.add_page(format=PAPERS_MM[plan.paper])
    left, top = (round(side / PIXEL_MM) for side in sheet.corner_mm)
    columns, rows = (round(side / PIXEL_MM) for side in sheet.size_mm)
    part = Image.fromarray(raster[top : top + rows, left : left + columns])
    packed = BytesIO()
    part.save(packed, "PNG", optimize=False)
    pdf.image(packed, MARGIN_MM, MARGIN_MM, *sheet.size_mm)
    _draw_trim_marks(pdf, plan, sheet)
    _draw_footer(pdf, plan, sheet)


def _draw_trim_marks(pdf: FPDF, plan: PatternSet, sheet: Sheet) -> None:
    """Where to cut a sheet that lies over its neighbour, and where the neighbour's cut edge comes to lie."""
    width, height = sheet.size_mm
    right, bottom = MARGIN_MM + width, MARGIN_MM + height
    pdf.set_draw_color(_BLACK)
    pdf.set_line_width(0.15)
    columns = [MARGIN_MM] * (sheet.column > 1) + [right - GLUE_MM] * (sheet.column < plan.columns)
    rows = [MARGIN_MM] * (sheet.row > 1) + [bottom - GLUE_MM] * (sheet.row < plan.rows)
    for x in columns:
        pdf.line(x, MARGIN_MM - _MARK_GAP_MM - _MARK_MM, x, MARGIN_MM - _MARK_GAP_MM)
        pdf.line(x, bottom + _MARK_GAP_MM, x, bottom + _MARK_GAP_MM + _MARK_MM)
    for y in rows:
        pdf.line(MARGIN_MM - _MARK_GAP_MM - _MARK_MM, y, MARGIN_MM - _MARK_GAP_MM, y)
        pdf.line(right + _MARK_GAP_MM, y, right + _MARK_GAP_MM + _MARK_MM, y)
    pdf.set_font("Helvetica", size=6)
    pdf.set_text_color(_GREY)
    if sheet.column < plan.columns:
        x, y = right + 4, bottom - 20
        with pdf.rotation(90, x, y):
            pdf.text(x, y, f"r{sheet.row}c{sheet.column + 1} {_OVER}")
    if sheet.row < plan.rows:
        pdf.text(MARGIN_MM + 12, bottom + 3.4, f"r{sheet.row + 1}c{sheet.column} {_OVER}")


def _draw_footer(pdf: FPDF, plan: PatternSet, sheet: Sheet) -> None:
    page_width, page_height = PAPERS_MM[plan.paper]
    base = page_height - MARGIN_MM
    tiled = plan.rows * plan.columns > 1
    place = f"row {sheet.row} of {plan.rows}, column {sheet.column} of {plan.columns}" if tiled else ""
    pdf.set_text_color(_BLACK)
    pdf.set_font("Helvetica", "B", 12)
    pdf.text(MARGIN_MM, base - 4.4, plan.pattern_id(sheet.pattern))
    if place:
        offset = pdf.get_string_width(plan.pattern_id(sheet.pattern)) + 3
        pdf.set_font("Helvetica", size=9)
        pdf.text(MARGIN_MM + offset, base - 4.4, place)
    pdf.set_font("Helvetica", size=6.5)
    pdf.set_text_color(_GREY)
    size = f"{plan.size_mm[0]:g} × {plan.size_mm[1]:g} mm"
    pdf.text(MARGIN_MM, base - 0.6, f"seed {plan.seed} · pattern {sheet.pattern} of {plan.patterns} · {size}")
    _draw_scale_bar(pdf, page_width - MARGIN_MM - SCALE_BAR_MM, base - 5.2)


def _draw_scale_bar(pdf: FPDF, x: float, y: float) -> None:
    """Ten boxes of ten millimetres, as on a map."""
    pdf.set_draw_color(_BLACK)
    pdf.set_fill_color(_BLACK)
    pdf.set_line_width(0.15)
    for box in range(round(SCALE_BAR_MM / _BAR_STEP_MM)):
        style = "DF" if box % 2 == 0 else "D"
        pdf.rect(x + box * _BAR_STEP_MM, y - _BAR_HEIGHT_MM / 2, _BAR_STEP_MM, _BAR_HEIGHT_MM, style=style)
    pdf.set_text_color(_BLACK)
    pdf.set_font("Helvetica", size=7)
    pdf.text(x, y + 4.6, "0")
    middle = "50"
    pdf.text(x + SCALE_BAR_MM / 2 - pdf.get_string_width(middle) / 2, y + 4.6, middle)
    end = f"{SCALE_BAR_MM:.0f} mm"
    pdf.text(x + SCALE_BAR_MM - pdf.get_string_width(end), y + 4.6, end)
