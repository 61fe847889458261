"""Intrinsics from a checkerboard: rendered boards of a known camera give that camera back."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_calib.camera_intrinsics import calibrate_intrinsics
from rig_calib.checkerboard import Board
from rig_calib.intrinsics import calibrate_unit, run
from rig_calib.projection import pixel_rays
from rig_protocol.camera import DEFAULT_DEPTH, CameraModel, Intrinsics
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.poses import Pose, inverse, se3_exp, so3_exp
from rig_protocol.rig_folder import read_json

BOARD = Board(8, 6, 0.03)
COLOR = Intrinsics(527.0, 524.0, 328.0, 251.0, dist=(0.12, -0.25, -0.001, 0.002, 0.0))
INFRARED = Intrinsics(588.0, 590.0, 316.0, 245.0, dist=(-0.1, 0.15, 0.0, 0.0, 0.0))
T_COLOR_INFRARED = se3_exp(np.array([0.002, -0.008, 0.004, -0.025, 0.0008, 0.003]))
TEXTURE_PX = 40  # a square of the board


def board_texture() -> np.ndarray:
    squares = np.indices((BOARD.rows + 1, BOARD.columns + 1)).sum(axis=0) % 2
    inner = np.kron(squares * 190 + 30, np.ones((TEXTURE_PX, TEXTURE_PX))).astype(np.uint8)
    return cv2.copyMakeBorder(inner, *(TEXTURE_PX,) * 4, cv2.BORDER_CONSTANT, value=220)


def photograph(camera: Intrinsics, T_camera_board: Pose) -> np.ndarray:
    """What a camera sees of the board on a grey wall; the board's first corner is its origin."""
    rays = np.concatenate([pixel_rays(camera), np.ones((camera.height, camera.width, 1))], axis=2)
    normal, origin = T_camera_board[:3, 2], T_camera_board[:3, 3]
    hits = rays * (origin @ normal / (rays @ normal))[..., None] - origin
    squares = hits @ T_camera_board[:3, :2] / BOARD.square_m
    texels = ((squares + 2) * TEXTURE_PX - 0.5).astype(np.float32)
    image = cv2.remap(
        board_texture(), texels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
    )
    noise = np.random.default_rng(0).normal(0, 1.5, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


def board_pose(tilt_x: float, tilt_y: float, x: float, y: float, z: float) -> Pose:
    """Pose of a board whose middle is at (x, y, z), tilted in degrees."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.deg2rad([tilt_x, tilt_y, 5.0]))
    middle = np.array([BOARD.columns - 1, BOARD.rows - 1, 0]) * BOARD.square_m / 2
    T[:3, 3] = np.array([x, y, z]) - T[:3, :3] @ middle
    return T


POSES = [
    board_pose(tilt_x, tilt_y, x, y, z)
    for tilt_x, tilt_y, x, y, z in [
        (30, 0, 0.05, 0.02, 0.55), (-30, 5, -0.10, -0.06, 0.60), (0, 35, 0.12, 0.07, 0.60),
        (5, -35, -0.12, 0.08, 0.55), (25, 25, 0.10, -0.07, 0.60), (-25, -25, -0.11, 0.06, 0.65),
        (-20, 30, 0.02, -0.05, 0.50), (20, -30, -0.02, 0.05, 0.50), (5, 5, 0.00, 0.00, 0.45),
    ]
]  # fmt: skip


@pytest.fixture(scope="module")
def color_images() -> dict[str, np.ndarray]:
    return {f"color_{k}.png": photograph(COLOR, T) for k, T in enumerate(POSES)}


@pytest.fixture(scope="module")
def infrared_images() -> dict[str, np.ndarray]:
    T_infrared_color = inverse(T_COLOR_INFRARED)
    return {f"ir_{k}.png": photograph(INFRARED, T_infrared_color @ T) for k, T in enumerate(POSES)}


def test_rendered_boards_give_the_camera_back(color_images: dict[str, np.ndarray]) -> None:
    estimate = calibrate_intrinsics(color_images, BOARD)
    found = estimate.intrinsics
    # Nine views of 48 corners at about 0.1 px; the principal point trades off against p1 and p2.
    assert (found.fx, found.fy) == pytest.approx((COLOR.fx, COLOR.fy), rel=2e-3)
    assert (found.cx, found.cy) == pytest.approx((COLOR.cx, COLOR.cy), abs=2.0)
    assert estimate.rms_px < 0.2
    assert len(estimate.views) == len(POSES)


def test_stated_standard_deviations_cover_the_error(color_images: dict[str, np.ndarray]) -> None:
    estimate = calibrate_intrinsics(color_images, BOARD)
    for name in ("fx", "fy", "cx", "cy"):
        error = getattr(estimate.intrinsics, name) - getattr(COLOR, name)
        assert abs(error) < 5 * estimate.sigma[name]  # rendering adds small systematic errors of its own


def test_an_undetermined_third_radial_term_stays_zero(color_images: dict[str, np.ndarray]) -> None:
    assert calibrate_intrinsics(color_images, BOARD).intrinsics.dist[4] == 0.0


def test_infrared_images_give_depth_camera_and_transform(
    color_images: dict[str, np.ndarray], infrared_images: dict[str, np.ndarray]
) -> None:
    model = calibrate_unit(color_images, BOARD, infrared_images).model
    assert model.depth is not None
    assert model.T_color_depth is not None
    assert model.depth.fx == pytest.approx(INFRARED.fx, rel=2e-3)
    # The depth image is the infrared image moved by 5 and 4 pixels.
    assert (model.depth.cx, model.depth.cy) == pytest.approx((INFRARED.cx - 5, INFRARED.cy - 4), abs=2.0)
    assert model.T_color_depth[:3, 3] == pytest.approx(T_COLOR_INFRARED[:3, 3], abs=1.5e-3)


def test_corners_found_from_the_other_end_of_the_board_do_not_turn_the_infrared_camera(
    color_images: dict[str, np.ndarray],
    infrared_images: dict[str, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    find = Board.find
    infrared = list(infrared_images.values())

    def from_the_other_end(board: Board, image: np.ndarray) -> np.ndarray | None:
        corners = find(board, image)
        turned = corners is not None and any(image is other for other in infrared[::2])
        return corners[::-1] if turned else corners

    monkeypatch.setattr(Board, "find", from_the_other_end)
    T = calibrate_unit(color_images, BOARD, infrared_images).model.T_color_depth
    assert T is not None
    assert T[:3, 3] == pytest.approx(T_COLOR_INFRARED[:3, 3], abs=1.5e-3)


def test_without_infrared_images_the_depth_side_is_the_known_one(color_images: dict[str, np.ndarray]) -> None:
    known = CameraModel(depth=INFRARED, source="factory")
    model = calibrate_unit(color_images, BOARD, known=known).model
    assert model.depth == INFRARED
    assert model.source == "file"


def test_too_few_boards_are_refused_and_every_image_without_one_is_named(
    color_images: dict[str, np.ndarray],
) -> None:
    few = dict(list(color_images.items())[:4])
    blank = {f"blank_{k}.png": np.full((480, 640), 128, np.uint8) for k in range(2)}
    with pytest.raises(DataError, match="4 usable images") as error:
        calibrate_intrinsics(few | blank, BOARD)
    assert "blank_0.png: no board found" in str(error.value)
    assert "blank_1.png: no board found" in str(error.value)


def test_boards_that_are_all_parallel_are_refused() -> None:
    images = {
        f"{k}.png": photograph(
            COLOR, board_pose(1.0, k - 3.0, 0.03 * (k - 3), 0.02 * (k - 3), 0.5 + 0.05 * k)
        )
        for k in range(6)
    }
    with pytest.raises(DataError, match="parallel"):
        calibrate_intrinsics(images, BOARD)


def test_images_of_different_size_are_refused_with_their_sizes(color_images: dict[str, np.ndarray]) -> None:
    images = color_images | {"small.png": np.zeros((240, 320), np.uint8)}
    with pytest.raises(DataError, match=r"small\.png 320×240"):
        calibrate_intrinsics(images, BOARD)


def test_a_view_that_does_not_fit_is_left_out_and_named(
    color_images: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    find, bent = Board.find, color_images["color_3.png"]

    def find_wrongly(board: Board, image: np.ndarray) -> np.ndarray | None:
        corners = find(board, image)
        if corners is not None and image is bent:
            corners[::3] += 9.0
        return corners

    monkeypatch.setattr(Board, "find", find_wrongly)
    estimate = calibrate_intrinsics(color_images, BOARD)
    assert list(estimate.rejected) == ["color_3.png"]
    assert estimate.intrinsics.fx == pytest.approx(COLOR.fx, rel=2e-3)


def test_the_file_is_a_camera_model_with_its_quality(
    tmp_path: Path, color_images: dict[str, np.ndarray]
) -> None:
    files = [tmp_path / name for name in color_images]
    for file, image in zip(files, color_images.values(), strict=True):
        cv2.imwrite(str(file), image)
    estimate = run(files, BOARD, tmp_path / "unit.json")
    values = read_json(tmp_path / "unit.json")
    assert CameraModel.from_dict(values).color == estimate.color.intrinsics
    assert CameraModel.from_dict(values).depth == DEFAULT_DEPTH
    assert values["source"] == "file"
    assert json.dumps(values["measured"]["color"]["sigma"]["fx"])
    assert values["measured"]["color"]["images"] == len(files)


def test_an_unreadable_image_is_named(tmp_path: Path) -> None:
    (tmp_path / "torn.png").write_bytes(b"\x89PNG")
    with pytest.raises(ConfigurationError, match=r"torn\.png is not a readable image"):
        run([tmp_path / "torn.png"], BOARD, tmp_path / "unit.json")


def test_each_infrared_image_needs_its_colour_image(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="one of both"):
        run([tmp_path / "a.png"], BOARD, tmp_path / "unit.json", [tmp_path / "b.png", tmp_path / "c.png"])


def test_board_text_gives_inner_corners_and_metres() -> None:
    assert Board.parse("9x6", 25.0) == Board(9, 6, 0.025)


@pytest.mark.parametrize("text", ["9", "9x", "axb", "9x6x2", "-9x6"])
def test_other_board_text_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="9x6"):
        Board.parse(text, 25.0)


@pytest.mark.parametrize(
    ("columns", "rows", "square_m"), [(2, 6, 0.03), (7, 7, 0.03), (9, 6, 0.0), (9, 6, 2.0)]
)
def test_a_board_that_calibrates_nothing_is_refused(columns: int, rows: int, square_m: float) -> None:
    with pytest.raises(ConfigurationError, match="cannot be used"):
        Board(columns, rows, square_m)
