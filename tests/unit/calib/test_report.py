"""The report stands alone, says what failed, and shows nothing that a hostile file could run."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from rig_calib.evidence import EdgeEvidence
from rig_calib.figures import charts, pictures, tables
from rig_calib.figures.dollhouse import dollhouse_picture, share_facing
from rig_calib.figures.plan_view import plan_view
from rig_calib.fusion.fused import FusedRig, fuse_rig
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.report import report_html, write_report
from rig_calib.rig_calibration import CalibratedEdge, LoopClosure, RigCalibration
from rig_protocol.poses import inverse, se3_exp
from support.box_room import CAMERA, calibration_of, ring_poses, room_views

POSES = ring_poses()
VIEWS = room_views(POSES)
SIGMA_DEG, SIGMA_MM = 0.1, 3.0


def covariance(scale: float = 1.0) -> np.ndarray:
    sigmas = np.array([np.deg2rad(SIGMA_DEG)] * 3 + [SIGMA_MM * 1e-3] * 3) * scale
    return np.diag(sigmas**2)


def edge(i: int, j: int, used: bool = True, reason: str | None = None) -> CalibratedEdge:
    return CalibratedEdge(i, j, 120, 80, 4.2, inverse(POSES[i]) @ POSES[j], used, reason)


def evidence(i: int, j: int, count: int = 60) -> EdgeEvidence:
    rng = np.random.default_rng(i)
    pixels = rng.uniform((0, 0), (CAMERA.width - 1, CAMERA.height - 1), (2, count, 2))
    residual = rng.exponential(1.0, count)
    residual[:3] = np.nan
    return EdgeEvidence(i, j, pixels[0], pixels[1], residual < 2.0, residual)


def good_calibration() -> RigCalibration:
    calibration = calibration_of(
        POSES,
        edges=tuple(edge(k, (k + 1) % 12) for k in range(12)),
        loop_closure=LoopClosure(1.23, 31.2, 0.02, 0.4),
        seconds={"features": 2.1, "matching": 1.2, "total": 3.4},
        created="2025-01-01T12:00:00Z",
        provenance={"source": "folder", "settings": {"method": "joint"}, "versions": {"numpy": "2"}},
    )
    cameras = tuple(
        replace(camera, covariance=covariance(1.0 + camera.id / 10)) for camera in calibration.cameras
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


def test_a_passed_calibration_says_so_and_how_well_the_worst_camera_is_known(page: str) -> None:
    text = PageReader(page).text
    assert "all 12 cameras are placed" in text
    assert "cam11, is known to 0.21° and 6.3 mm" in text


def test_every_camera_and_every_edge_has_its_row(page: str) -> None:
    text = PageReader(page).text
    for k in range(12):
        assert f"cam{k:02d} – cam{(k + 1) % 12:02d}" in text


def test_matches_residuals_loop_time_and_settings_are_there(page: str) -> None:
    text = PageReader(page).text
    for part in (
        "Matches",
        "Residuals",
        "Before loop closure",
        "1.23°",
        "features",
        "settings.method",
        "joint",
    ):
        assert part in text
    # panorama, two sides of the cloud, before and after, twelve edges
    assert len(PageReader(page).all("img")) == 1 + 2 + 2 + 12


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


def test_matches_of_an_edge_that_failed_are_shown_too() -> None:
    page = report_html(calibration_of({}), VIEWS, [evidence(3, 4)])
    assert "cam03 – cam04" in PageReader(page).text
    assert len(PageReader(page).all("img")) == 1


def test_poses_before_loop_closure_may_be_in_a_frame_of_their_own(fused: FusedRig) -> None:
    T_other_rig = se3_exp(np.array([0.3, 0.2, 1.0, 4.0, 5.0, 6.0]))
    same_elsewhere = {k: T_other_rig @ T for k, T in POSES.items()}
    page = report_html(calibration_of(POSES), VIEWS, (), same_elsewhere, fused)
    pictures_of_cuts = [image["src"] for image in PageReader(page).all("img") if "Walls" in str(image["alt"])]
    assert len(pictures_of_cuts) == 2
    assert len(set(pictures_of_cuts)) == 1


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
    assert plan.svg.count('class="uncertainty"') == 12
    unsure = plan_view(calibration_of(POSES), intrinsics, T_rig_view)
    assert unsure.magnification is None
    assert "uncertainty" not in unsure.svg


def test_a_portrait_pair_stands_upright_with_its_matches_on_the_same_pixels() -> None:
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    image[:, -20:] = (0, 255, 0)  # image +x is down in the world
    pixels = np.array([[150.0, 60.0]])
    match = EdgeEvidence(0, 1, pixels, pixels, np.array([True]), np.array([0.2]))
    picture = pictures.match_picture(match, image, image, portrait=True, i_is_left=False)
    assert picture.shape[0] > picture.shape[1] / 2
    assert (picture[-10, 5] > (0, 150, 0)).tolist() == [False, True, False]
    left = picture[:, : picture.shape[1] // 2 - 10]
    rows = np.flatnonzero((left[..., 0] > 150).any(axis=1))
    assert rows.min() > 0.9 * picture.shape[0]  # the mark lies on the green, where its pixel is


def test_a_cut_shows_a_camera_out_of_place_as_a_second_line(fused: FusedRig) -> None:
    T_rig_view = rig_viewpoint(POSES, "ring").T_rig_view
    limits = pictures.view_limits(fused.surfaces, POSES, T_rig_view)
    right = pictures.slice_picture(fused.surfaces, POSES, T_rig_view, limits)
    moved = POSES | {0: POSES[0] @ se3_exp(np.array([0, 0, 0, 0, 0, 0.2]))}
    wrong = pictures.slice_picture(fused.surfaces, moved, T_rig_view, limits)
    assert right.shape == wrong.shape
    assert np.count_nonzero(right != wrong) > 100


def test_the_outside_view_leaves_out_what_faces_away(fused: FusedRig) -> None:
    picture = dollhouse_picture(fused.cloud, np.eye(4))
    drawn = (picture != picture[0, 0]).any(axis=2).mean()
    assert 0.1 < drawn < 0.95
    shares = [share_facing(fused.cloud, np.eye(4), azimuth) for azimuth in (25.0, 205.0)]
    assert shares == pytest.approx([0.5, 0.5], abs=0.1)


def test_the_worst_direction_of_a_pose_is_stated() -> None:
    camera = replace(good_calibration().cameras[0], covariance=np.diag([1e-6, 4e-6, 1e-6, 1e-6, 1e-6, 9e-6]))
    sigma = tables.worst_sigma(camera)
    assert sigma is not None
    assert sigma.deg == pytest.approx(np.rad2deg(2e-3))
    assert sigma.mm == pytest.approx(3.0)


def test_the_camera_that_defines_the_frame_states_no_uncertainty() -> None:
    camera = good_calibration().cameras[0]
    assert tables.worst_sigma(replace(camera, covariance=np.zeros((6, 6)))) is None
    assert tables.worst_sigma(replace(camera, covariance=None)) is None


def test_orientation_is_told_as_people_see_it() -> None:
    calibration = good_calibration()
    tilted = POSES | {0: POSES[0] @ se3_exp(np.array([0, np.deg2rad(5), 0, 0, 0, 0]))}
    calibration = replace(
        calibration, cameras=tuple(replace(c, T_rig_camera=tilted[c.id]) for c in calibration.cameras)
    )
    rows = tables.camera_rows(calibration, VIEWS, rig_viewpoint(POSES, "ring"))
    assert (rows[3]["azimuth"], rows[3]["elevation"], rows[3]["roll"]) == ("90.00", "0.00", "0.00")
    assert rows[0]["elevation"] == "-5.00"  # image x points down: turning about y tips the camera down
