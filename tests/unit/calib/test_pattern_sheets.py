"""Rules of a printed set: true size on the chosen paper, no sheet twice, tiles that join, the same file."""

import hashlib
import json
import re
import zlib
from itertools import product
from pathlib import Path

import pytest

from rig_calib.pattern import descriptor_pattern
from rig_calib.pattern_layout import GLUE_MM, PAPERS_MM, PIXEL_MM, Sheet, plan_patterns
from rig_calib.pattern_sheets import pattern_pdf, write_pattern_set
from rig_protocol.errors import ConfigurationError

POINTS_A_MM = 72 / 25.4


def page_sizes_mm(pdf: bytes) -> list[tuple[float, float]]:
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    return [(float(width) / POINTS_A_MM, float(height) / POINTS_A_MM) for width, height in boxes]


def image_sizes_mm(pdf: bytes) -> list[tuple[float, float]]:
    """Width and height at which the images of the pages are drawn."""
    sizes = []
    for stream in re.findall(rb"stream\n(.*?)\nendstream", pdf, re.DOTALL):
        try:
            content = zlib.decompress(stream)
        except zlib.error:
            continue
        for width, height in re.findall(rb"q ([\d.]+) 0 0 ([\d.]+) [\d.]+ [\d.]+ cm /I\d+ Do Q", content):
            sizes.append((float(width) / POINTS_A_MM, float(height) / POINTS_A_MM))
    return sizes


@pytest.mark.parametrize("paper", PAPERS_MM)
def test_patterns_are_printed_at_their_true_size(paper: str) -> None:
    plan = plan_patterns(paper, seed=1, cameras=12, patterns=1)
    pdf, _ = pattern_pdf(plan)
    guide, sheet = page_sizes_mm(pdf)
    assert guide == pytest.approx((210, 297), abs=0.01), "the page that explains is for any printer"
    assert sheet == pytest.approx(PAPERS_MM[paper], abs=0.01)
    assert image_sizes_mm(pdf) == [pytest.approx(plan.size_mm, abs=0.01)]
    assert plan.shape == (plan.size_mm[1] / PIXEL_MM, plan.size_mm[0] / PIXEL_MM)


def test_the_same_set_is_the_same_file() -> None:
    plan = plan_patterns("A4", seed=5, cameras=12, patterns=2)
    assert pattern_pdf(plan) == pattern_pdf(plan)


@pytest.mark.parametrize(("tiles", "size_m"), [("3x4", None), (None, "0.9x1.2"), ("2x1", None)])
def test_tiles_show_all_of_a_pattern_and_share_a_strip(tiles: str | None, size_m: str | None) -> None:
    plan = plan_patterns("A4", 1, 12, 1, tiles, size_m)
    sheets = {(sheet.row, sheet.column): sheet for sheet in plan.sheets(1)}
    assert set(sheets) == set(product(range(1, plan.rows + 1), range(1, plan.columns + 1)))
    for (row, column), sheet in sheets.items():
        assert far_corner(sheet) <= plan.size_mm
        for axis, neighbour in ((1, sheets.get((row + 1, column))), (0, sheets.get((row, column + 1)))):
            end = plan.size_mm[axis] if neighbour is None else neighbour.corner_mm[axis] + GLUE_MM
            assert far_corner(sheet)[axis] == end


def far_corner(sheet: Sheet) -> tuple[float, float]:
    return sheet.corner_mm[0] + sheet.size_mm[0], sheet.corner_mm[1] + sheet.size_mm[1]


def test_the_record_names_every_sheet_once_and_lets_a_raster_be_made_again(tmp_path: Path) -> None:
    plan = plan_patterns("A4", seed=5, cameras=12, patterns=2, tiles="1x2")
    pdf, record = write_pattern_set(tmp_path, plan)
    told = json.loads(record.read_text())
    sheets = [sheet for pattern in told["patterns"] for sheet in pattern["sheets"]]
    ids = [sheet["id"] for sheet in sheets]
    assert len(set(ids)) == len(ids) == plan.sheet_count
    assert [sheet["page"] for sheet in sheets] == list(range(2, len(page_sizes_mm(pdf.read_bytes())) + 1))
    shape = round(told["size_mm"][1] / told["pixel_mm"]), round(told["size_mm"][0] / told["pixel_mm"])
    for pattern in told["patterns"]:
        raster = descriptor_pattern(told["seed"], pattern["pattern"], shape, told["pixel_mm"])
        assert hashlib.sha256(raster.tobytes()).hexdigest() == pattern["raster_sha256"]


@pytest.mark.parametrize("paper", PAPERS_MM)
def test_the_default_set_serves_every_overlap_of_the_ring_alike(paper: str) -> None:
    plan = plan_patterns(paper, seed=1, cameras=12)
    assert plan.per_overlap is not None
    height_mm = plan.per_overlap * plan.size_mm[1]
    assert 900 <= height_mm <= 1700, "of the 2.2 m that neighbours share at two metres"


def test_an_arc_needs_no_sheets_where_its_ends_do_not_meet() -> None:
    assert plan_patterns("A3", seed=1, cameras=4).patterns == 9


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"paper": "letter"}, "A4"),
        ({"tiles": "3by4"}, "3x4"),
        ({"tiles": "1.5x2"}, "3x4"),
        ({"tiles": "0x2"}, "1 to 99"),
        ({"tiles": "30x30"}, "3 m"),
        ({"size_m": "900x1200"}, "3 m"),
        ({"size_m": "0.01x1"}, "metres"),
        ({"size_m": "1x1", "tiles": "2x2"}, "one of them"),
        ({"patterns": 5000}, "different seeds"),
    ],
)
def test_what_cannot_be_printed_is_refused_with_a_way_out(options: dict[str, str | int], told: str) -> None:
    asked = {"paper": "A3", "seed": 1, "cameras": 12} | options
    with pytest.raises(ConfigurationError, match=told):
        plan_patterns(**asked)  # type: ignore[arg-type] # one table of options of several types
