"""The report stands alone, says what failed, and shows nothing that a hostile file could run."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_calib.depth_model import DepthCorrection
from rig_calib.displacement import pair_uncertainties
from rig_calib.evidence import EdgeEvidence
from rig_calib.figures import charts, pictures, tables
from rig_calib.figures.advice import advice
from rig_calib.figures.bias_maps import bias_map_mm, bias_maps
from rig_calib.figures.case import ReportCase
from rig_calib.figures.dollhouse import dollhouse_picture, share_facing
from rig_calib.figures.overlaps import overlap_cards
from rig_calib.figures.plan_view import plan_view
from rig_calib.fusion.fused import FusedRig, fuse_rig
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.overlap import Region, whole_image
from rig_calib.projection import project
from rig_calib.report import report_html, write_report
from rig_calib.rig_calibration import CalibratedEdge, LoopClosure, RigCalibration
from rig_protocol.poses import inverse, se3_exp, transform_points
from support.box_room import CAMERA, BoxRoom, calibration_of, ring_poses, room_views

POSES = ring_poses()
VIEWS = room_views(POSES)
SIGMA_DEG, SIGMA_MM = 0.1, 3.0
WORST = 3  # the pair of cameras 3 and 4 is three times less certain than the others


def covariance(scale: float = 1.0) -> np.ndarray:
    sigmas = np.array([np.deg2rad(SIGMA_DEG)] * 3 + [SIGMA_MM * 1e-3] * 3) * scale
    return np.diag(sigmas**2)


def edge(i: int, j: int, used: bool = True, reason: str | None = None, scale: float = 1.0) -> CalibratedEdge:
    T_i_j = inverse(POSES[i]) @ POSES[j]
    return CalibratedEdge(i, j, 120, 80, 4.2, T_i_j, used, reason, covariance(scale))


def evidence(i: int, j: int, count: int = 60) -> EdgeEvidence:
    rng = np.random.default_rng(i)
    pixels = rng.uniform((0, 0), (CAMERA.width - 1, CAMERA.height - 1), (2, count, 2))
    residual = rng.exponential(1.0, count)
    residual[:3] = np.nan
    errors = rng.standard_normal(2 * count), rng.standard_normal(count)
    return EdgeEvidence(i, j, pixels[0], pixels[1], residual < 2.0, residual, 0, *errors)


def good_calibration() -> RigCalibration:
    calibration = calibration_of(
        POSES,
        edges=tuple(edge(k, (k + 1) % 12, scale=3.0 if k == WORST else 1.0) for k in range(12)),
        loop_closure=LoopClosure(1.23, 31.2, 0.02, 0.4),
        seconds={"features": 2.1, "matching": 1.2, "total": 3.4},
        created="2025-01-01T12:00:00Z",
        provenance={"source": "folder", "settings": {"method": "joint"}, "versions": {"numpy": "2"}},
    )
    cameras = tuple(
        replace(
            camera,
            covariance=covariance(5.0),
            aligned_covariance=covariance(1.0 + camera.id / 10),
            depth_correction=DepthCorrection((0.01 * camera.id / 11,)),
        )
        for camera in calibration.cameras
    )
    return replace(calibration, cameras=cameras)


@pytest.fixture(scope="module")
def fused() -> FusedRig:
    return fuse_rig(VIEWS, calibration_of(POSES), circle_px=700)


@pytest.fixture(scope="module")
def page(fused: FusedRig) -> str:
    before = {k: T @ se3_exp(np.full(6, 0.005)) for k, T in POSES.items()}
    matches = [evidence(k, (k + 1) % 12) for k in range(12)]
    return report_html(good_calibration(), VIEWS, matches, before, fused)


def evidence_within(i: int, j: int) -> EdgeEvidence:
    """Matches in the middle of the strip that camera i shares with camera j, and of j's."""
    seen = project(CAMERA, transform_points(inverse(POSES[i]), middle := between(i, j)))
    return EdgeEvidence(
        i,
        j,
        seen,
        project(CAMERA, transform_points(inverse(POSES[j]), middle)),
        np.ones(len(seen), dtype=bool),
        np.zeros(len(seen)),
    )


def between(i: int, j: int) -> np.ndarray:
    """Points 1.7 m away, where both cameras look."""
    axis = POSES[i][:3, 2] + POSES[j][:3, 2]
    return 1.7 * axis / np.linalg.norm(axis) + np.outer(np.linspace(-0.4, 0.4, 9), (0.0, 0.0, 1.0))


class PageReader(HTMLParser):
    """Collects what a browser would see: elements with attributes, and the text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def test_the_page_stands_alone(page: str) -> None:
    reader = PageReader(page)
    without_pictures = re.sub(r"data:image/[a-z]+;base64,[A-Za-z0-9+/=]+", "data:", page)
    assert not re.search(r"https?:|//|@import|url\(", without_pictures)
    assert not reader.all("script")
    assert not reader.all("link")
    sources = [attributes["src"] for attributes in reader.all("img")]
    assert sources
    assert all(source is not None and source.startswith("data:image/") for source in sources)


def test_every_picture_is_described_for_those_who_cannot_see_it(page: str) -> None:
    reader = PageReader(page)
    assert all(attributes.get("alt") for attributes in reader.all("img"))
    assert all(attributes.get("aria-label") for attributes in reader.all("svg"))


def test_light_and_dark_readers_are_both_served(page: str) -> None:
    assert "prefers-color-scheme: dark" in page


def test_a_passed_calibration_says_so_and_which_pair_is_known_least(page: str) -> None:
    """From relative poses: the rig's common turn against its drawing (0.5° here) is no fault of a pair."""
    text = PageReader(page).text
    assert "all 12 cameras are placed" in text
    assert "Least certain: cam04 against cam03, " in text
    stated = re.search(r"points at 3 m are displaced by ([\d.]+) mm", text)
    assert stated is not None
    by_turns, by_slides = np.deg2rad(3 * SIGMA_DEG) * 3e3 * np.sqrt(2), 3 * SIGMA_MM * np.sqrt(3)
    assert float(stated.group(1)) == pytest.approx(np.hypot(by_turns, by_slides), rel=0.1)


def test_the_least_certain_overlap_stands_out_in_chart_plan_table_and_matches(page: str) -> None:
    reader = PageReader(page)
    marked = [
        (tag, str(values["class"])) for tag, values in reader.elements if "worst" in str(values.get("class"))
    ]
    assert [tag for tag, _ in marked].count("tr") == 1
    assert ("div", "card worst") in marked
    assert ("line", "edge edge-worst") in marked
    assert [tag for tag, _ in marked].count("text") == 4  # the plan's number; the chart's, and two names


def test_a_method_without_covariance_says_that_it_states_none() -> None:
    calibration = calibration_of(
        POSES, edges=tuple(replace(edge(k, (k + 1) % 12), relative_covariance=None) for k in range(12))
    )
    text = PageReader(report_html(replace(calibration, method="paper"), VIEWS)).text
    assert "It states no uncertainty of relative poses (method paper)." in text
    assert "calibrate with --method joint" in text
    assert "states no uncertainties" in text


def test_what_would_help_most_names_the_overlaps_and_what_to_do() -> None:
    edges = (edge(0, 1), edge(1, 2), edge(2, 3, scale=4.0), edge(3, 4, used=False, reason="few", scale=9.0))
    calibration = replace(good_calibration(), edges=edges, loop_closure=None)
    pairs = pair_uncertainties(calibration, np.eye(4))
    unused, weak, loop = advice(calibration, pairs, {k: f"cam{k:02d}" for k in POSES})
    assert unused.startswith("cam03 – cam04: hang a pattern")
    assert weak.startswith("cam02 – cam03: 80 matches leave")
    assert loop.startswith("No loop of overlaps closes")


def test_an_overlap_that_the_others_make_up_for_is_not_asked_for() -> None:
    edges = (edge(0, 1), edge(1, 2), edge(0, 2), edge(2, 3, used=False, reason="few"))
    calibration = replace(good_calibration(), edges=edges)
    assert advice(calibration, pair_uncertainties(calibration, np.eye(4)), {}) == []


def test_nothing_is_advised_when_nothing_stands_out() -> None:
    calibration = replace(good_calibration(), edges=tuple(edge(k, (k + 1) % 12) for k in range(12)))
    assert advice(calibration, pair_uncertainties(calibration, np.eye(4)), {}) == []


def test_a_passed_calibration_with_warnings_is_no_plain_green() -> None:
    warned = report_html(replace(good_calibration(), warnings=("edge 3–4 is not used",)), VIEWS)
    failed = report_html(replace(good_calibration(), failures=("camera 3 is not connected",)), VIEWS)
    for page, css in ((warned, "verdict caution"), (failed, "verdict failed")):
        assert [values["class"] for values in PageReader(page).all("div") if values.get("role")] == [css]


def test_before_is_without_depth_correction_and_after_with_it() -> None:
    """Exact poses, depth scaled wrongly by what the correction takes back: only the correction helps."""
    scaled = [
        replace(
            view,
            depth_mm=tuple(
                (image / (1 + 0.004 * view.camera_id)).astype(np.uint16) for image in view.depth_mm
            ),
        )
        for view in VIEWS
    ]
    calibration = good_calibration()
    cameras = tuple(
        replace(c, depth_correction=DepthCorrection((0.004 * c.id,))) for c in calibration.cameras
    )
    calibration = replace(calibration, cameras=cameras)
    fused = fuse_rig(scaled, calibration, circle_px=300)
    before, after = ReportCase.of(calibration, scaled, (), POSES, fused).stages
    assert (before.name, after.name) == ("before", "after")
    assert after.differences_mm.keys() == before.differences_mm.keys()
    assert np.median(list(before.differences_mm.values())) > 2 * np.median(
        list(after.differences_mm.values())
    )
    measured = before.surface(11)
    assert measured is not None
    as_it_is = replace(measured, points_m=measured.points_m * np.float32(1.044))
    assert np.median(BoxRoom().wall_error_m(as_it_is.points_at(POSES[11]))) < 2e-3


def test_every_camera_and_every_edge_has_its_row(page: str) -> None:
    text = PageReader(page).text
    for k in range(12):
        assert f"cam{k:02d} – cam{(k + 1) % 12:02d}" in text


def test_the_key_figures_tell_how_many_accelerometers_were_heard() -> None:
    known = good_calibration()
    assert "down felt by" not in tables.key_figures(known, 12)
    felt = replace(known, provenance={**known.provenance, "gravity_cameras": [0, 1, 5]})
    assert tables.key_figures(felt, 12)["down felt by"] == "3 of 12 cameras"


def test_matches_residuals_loop_time_and_settings_are_there(page: str) -> None:
    text = PageReader(page).text
    for part in (
        "Matches",
        "Residuals",
        "Depth bias",
        "Before: pairs chained",
        "1.23°",
        "features",
        "settings.method",
        "joint",
    ):
        assert part in text
    # panorama; two sides of the cloud and a cut, twice; twelve maps; a picture and two cuts an edge
    assert len(PageReader(page).all("img")) == 1 + 2 * (2 + 1) + 12 + 12 * (1 + 2)
    histograms = [
        str(values["aria-label"]) for values in PageReader(page).all("svg") if "spread" in str(values)
    ]
    assert len(histograms) == 2 + 12 * 2


def test_a_page_of_twelve_cameras_can_be_sent_by_mail(page: str) -> None:
    assert len(page) < 8e6


def test_failures_are_listed_first_and_word_for_word() -> None:
    failure = "cam05 is connected by no edge: put a pattern where cam04 and cam05 overlap"
    text = PageReader(report_html(replace(good_calibration(), failures=(failure,)), VIEWS)).text
    assert "did not pass: one problem" in text
    assert text.index(failure) < text.index("cam00")


def test_warnings_and_cameras_left_out_of_the_cloud_are_listed() -> None:
    known = {k: T for k, T in POSES.items() if k != 7}
    calibration = calibration_of(known, warnings=("clock of cam02 drifts",))
    text = PageReader(report_html(calibration, VIEWS, fused=fuse_rig(VIEWS, calibration, circle_px=300))).text
    assert "clock of cam02 drifts" in text
    assert "cam07: left out, the calibration could not place it" in text
    assert "not placed" in text


def test_an_edge_that_was_not_used_says_why() -> None:
    reason = "only 5 matches agree; add a pattern"
    calibration = replace(good_calibration(), edges=(edge(0, 1), edge(1, 2, used=False, reason=reason)))
    assert reason in PageReader(report_html(calibration, VIEWS)).text


def test_names_and_messages_from_files_cannot_run_in_the_browser() -> None:
    attack = "<script>alert(1)</script>"
    views = [replace(VIEWS[0], name=attack), *VIEWS[1:]]
    calibration = good_calibration()
    cameras = (replace(calibration.cameras[0], name=attack), *calibration.cameras[1:])
    hostile = replace(
        calibration, cameras=cameras, failures=(attack,), warnings=(attack,), seconds={attack: 1.0}
    )
    page = report_html(hostile, views, [evidence(0, 1)], fused=fuse_rig(views, hostile, circle_px=300))
    assert "<script" not in page
    assert not PageReader(page).all("script")


def test_a_calibration_that_placed_no_camera_still_has_a_report(tmp_path: Path) -> None:
    calibration = calibration_of({}, failures=("no two cameras share a view: add patterns",))
    fused = fuse_rig(VIEWS, calibration)
    write_report(tmp_path / "report.html", calibration, VIEWS, fused=fused)
    text = PageReader((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert "0 of 12 cameras placed" in text
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_where_overlaps_are_many_the_least_certain_are_drawn_and_all_are_in_the_table() -> None:
    edges = [
        edge(k, (k + step) % 12, scale=3.0 if (k, step) == (3, 2) else 1.0)
        for k in range(12)
        for step in (1, 2)
    ]
    reader = PageReader(report_html(replace(good_calibration(), edges=tuple(edges)), VIEWS))
    assert "The 16 least certain of 24 overlaps." in reader.text
    assert [str(values["class"]) for values in reader.all("text")].count("label worst") == 4
    assert len([values for values in reader.all("rect") if values["class"] == "fill-step-3"]) == 16 + 1


def test_matches_of_an_edge_that_failed_are_shown_too() -> None:
    page = report_html(calibration_of({}), VIEWS, [evidence(3, 4)])
    assert "cam03 – cam04" in PageReader(page).text
    assert len(PageReader(page).all("img")) == 1


def test_poses_before_loop_closure_may_be_in_a_frame_of_their_own(fused: FusedRig) -> None:
    T_other_rig = se3_exp(np.array([0.3, 0.2, 1.0, 4.0, 5.0, 6.0]))
    same_elsewhere = {k: T_other_rig @ T for k, T in POSES.items()}
    page = report_html(calibration_of(POSES), VIEWS, (), same_elsewhere, fused)
    shown = {str(image["alt"]): image["src"] for image in PageReader(page).all("img")}
    for what in ("Walls", "cloud seen from above the back"):
        before, after = (source for alt, source in shown.items() if what in alt)
        assert before == after


# ---- figures


def test_a_histogram_puts_what_is_too_large_into_its_last_bin() -> None:
    chart = charts.histogram(np.array([0.1, 99.0]), np.array([50.0]), 5.0, "px", "all edges")
    assert "≥ 5" in chart
    assert "2 kept" in chart
    assert chart.count('class="fill-good"') == 2
    assert chart.count('class="fill-bad"') == 1


def test_an_ellipse_has_the_axes_of_its_covariance() -> None:
    turn = np.deg2rad(30)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    shape = charts.ellipse(np.zeros(2), R @ np.diag([9.0, 4.0]) @ R.T, 1.0, "uncertainty")
    assert 'rx="3.00" ry="2.00"' in shape
    angle = float(re.search(r"rotate\((-?[\d.]+)\)", shape).group(1))  # type: ignore[union-attr]
    assert angle % 180 == pytest.approx(30, abs=0.1)


def test_the_plan_tells_by_how_much_ellipses_are_magnified() -> None:
    calibration = good_calibration()
    T_rig_view = rig_viewpoint(calibration.poses, "ring").T_rig_view
    intrinsics = dict.fromkeys(POSES, CAMERA)
    plan = plan_view(calibration, intrinsics, T_rig_view)
    assert plan.magnification == 2
    assert "(× 2)" in plan.svg
    assert plan.svg.count('class="uncertainty"') == 12
    unsure = plan_view(calibration_of(POSES), intrinsics, T_rig_view)
    assert unsure.magnification is None
    assert "uncertainty" not in unsure.svg


def test_a_portrait_pair_stands_upright_with_its_matches_on_the_same_pixels() -> None:
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    image[:, -20:] = (0, 255, 0)  # image +x is down in the world
    pixels = np.array([[150.0, 60.0]])
    match = EdgeEvidence(0, 1, pixels, pixels, np.array([True]), np.array([0.2]))
    whole = (whole_image(CAMERA), whole_image(CAMERA))
    picture = pictures.match_picture(match, (image, image), whole, portrait=True, i_is_left=False)
    assert picture.shape[0] > picture.shape[1] / 2
    assert (picture[-10, 5] > (0, 150, 0)).tolist() == [False, True, False]
    left = picture[:, : picture.shape[1] // 2 - 10]
    rows = np.flatnonzero((left[..., 0] > 150).any(axis=1))
    assert rows.min() > 0.9 * picture.shape[0]  # the mark lies on the green, where its pixel is


def test_a_match_picture_shows_the_overlap_only_and_no_match_outside_it() -> None:
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    pixels = np.array([[30.0, 30.0], [150.0, 100.0]])
    match = EdgeEvidence(0, 1, pixels, pixels, np.array([True, True]), np.zeros(2))
    region = Region(10, 20, 90, 60)
    picture = pictures.match_picture(match, (image, image), (region, region), portrait=True, i_is_left=True)
    half = picture[:, : (picture.shape[1] - 6) // 2]
    assert half.shape[0] / half.shape[1] == pytest.approx(80 / 40, rel=0.02)  # upright: image x is down
    marked = np.argwhere((half > 100).all(axis=2) | (half[..., 0] > 200))
    scale = half.shape[0] / 80
    expected = (scale * 20.5, scale * (40 - 10.5))  # row: x within the region; column: y from the right
    assert np.abs(marked[marked[:, 1] <= expected[1]].mean(axis=0) - expected).max() < 4 * scale


def test_the_cards_show_what_the_other_camera_sees(fused: FusedRig) -> None:
    """Neighbours of a portrait ring share a strip: its picture is no wider than half of both images."""
    case = ReportCase.of(good_calibration(), VIEWS, [evidence_within(0, 1)], POSES, fused)
    card = overlap_cards(case)[0]
    data = np.frombuffer(base64.b64decode(card.matches.data_uri.split(",")[1]), np.uint8)
    height, width = cv2.imdecode(data, cv2.IMREAD_COLOR).shape[:2]
    assert width / height < 0.5 * (2 * CAMERA.height / CAMERA.width)
    assert [figure.caption.split(":")[0] for figure in card.cuts] == ["before", "after"]


def test_standardised_residuals_are_drawn_against_the_normal_curve() -> None:
    values = 0.5 * np.random.default_rng(0).standard_normal(4000)
    chart = charts.normal_histogram(values, "pixels")
    assert "spread 0.5" in chart
    assert chart.count('class="curve"') == 1
    assert charts.robust_spread(np.append(values, 1e6)) == pytest.approx(0.5, rel=0.05)
    assert charts.robust_spread(np.empty(0)) == 0.0


@pytest.mark.parametrize(
    ("value", "ceiling"), [(0.7, 0.8), (1.0, 1.0), (25.8, 30.0), (81.0, 100.0), (0.0, 1.0)]
)
def test_axes_end_at_round_numbers(value: float, ceiling: float) -> None:
    assert charts.nice_ceiling(value) == pytest.approx(ceiling)


def test_a_bias_map_is_what_the_correction_adds_at_its_distance() -> None:
    view = VIEWS[0]  # its depth lives on the colour image
    flat = bias_map_mm(view, DepthCorrection((0.01,)))
    np.testing.assert_allclose(flat, 15.0)
    sloped = bias_map_mm(view, DepthCorrection((0.0, 0.02)))
    x = (np.array([0.0, CAMERA.width - 1]) - CAMERA.cx) / CAMERA.fx
    np.testing.assert_allclose(sloped[0, [0, -1]], 0.02 * x * 1500.0)


def test_bias_maps_share_one_scale() -> None:
    maps, limit_mm = bias_maps(ReportCase.of(good_calibration(), VIEWS))
    assert limit_mm == 20.0  # the largest is 1 % of 1.5 m
    assert [figure.caption for figure in (maps[0], maps[11])] == [
        "cam00: +0 to +0 mm",
        "cam11: +15 to +15 mm",
    ]
    assert bias_maps(ReportCase.of(calibration_of(POSES), VIEWS))[0] == []


def test_a_cut_shows_a_camera_out_of_place_as_a_second_line(fused: FusedRig) -> None:
    T_rig_view = rig_viewpoint(POSES, "ring").T_rig_view
    limits = pictures.view_limits(fused.surfaces, POSES, T_rig_view)
    right = pictures.slice_picture(fused.surfaces, POSES, T_rig_view, limits)
    moved = POSES | {0: POSES[0] @ se3_exp(np.array([0, 0, 0, 0, 0, 0.2]))}
    wrong = pictures.slice_picture(fused.surfaces, moved, T_rig_view, limits)
    assert right.shape == wrong.shape
    assert np.count_nonzero(right != wrong) > 100


def test_two_clouds_in_one_frame_are_seen_from_one_place(fused: FusedRig) -> None:
    """The smaller cloud does not fill the picture."""
    part = replace(fused.cloud, points_m=fused.cloud.points_m * np.float32(0.5))
    alone, framed = (dollhouse_picture(part, np.eye(4), framed_by=by) for by in (None, fused.cloud))
    drawn = [(picture != (24, 22, 20)).any(axis=2).mean() for picture in (alone, framed)]
    assert drawn[1] < 0.5 * drawn[0]


def test_the_outside_view_leaves_out_what_faces_away(fused: FusedRig) -> None:
    picture = dollhouse_picture(fused.cloud, np.eye(4))
    drawn = (picture != picture[0, 0]).any(axis=2).mean()
    assert 0.1 < drawn < 0.95
    shares = [share_facing(fused.cloud, np.eye(4), azimuth) for azimuth in (25.0, 205.0)]
    assert shares == pytest.approx([0.5, 0.5], abs=0.1)


def test_the_worst_direction_of_a_pose_is_stated() -> None:
    sigma = tables.worst_sigma(np.diag([1e-6, 4e-6, 1e-6, 1e-6, 1e-6, 9e-6]))
    assert sigma is not None
    assert sigma.deg == pytest.approx(np.rad2deg(2e-3))
    assert sigma.mm == pytest.approx(3.0)


def test_the_camera_that_defines_the_frame_states_no_uncertainty() -> None:
    assert tables.worst_sigma(np.zeros((6, 6))) is None
    assert tables.worst_sigma(None) is None


def test_a_camera_is_told_with_its_place_in_the_rig_and_against_the_frame() -> None:
    row = tables.camera_rows(good_calibration(), VIEWS, rig_viewpoint(POSES, "ring"))[0]
    assert row["sigma"] == "0.10° / 3.0 mm"
    assert row["sigma_frame"] == "0.50° / 15.0 mm"


def test_orientation_is_told_as_people_see_it() -> None:
    calibration = good_calibration()
    tilted = POSES | {0: POSES[0] @ se3_exp(np.array([0, np.deg2rad(5), 0, 0, 0, 0]))}
    calibration = replace(
        calibration, cameras=tuple(replace(c, T_rig_camera=tilted[c.id]) for c in calibration.cameras)
    )
    rows = tables.camera_rows(calibration, VIEWS, rig_viewpoint(POSES, "ring"))
    assert (rows[3]["azimuth"], rows[3]["elevation"], rows[3]["roll"]) == ("90.00", "0.00", "0.00")
    assert rows[0]["elevation"] == "-5.00"  # image x points down: turning about y tips the camera down
