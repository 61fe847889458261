"""Rerun recordings, read by Rerun's own reader: entities, units, directions, timelines."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from rig_calib.frame_exports import rerun
from rig_protocol.camera import Intrinsics
from rig_protocol.errors import RigError
from rig_protocol.poses import Pose
from support.box_takes import (
    CREATED_NS,
    CREATED_UNIX_NS,
    DEPTH,
    MODEL,
    PERIOD_NS,
    POSES,
    ROOM,
    box_calibration,
    box_description,
    box_frame,
    box_panorama,
    export_job,
    seen_by,
    wall_point,
    write_take,
)

Columns = Mapping[str, Sequence[Any]]
"""`ENTITY COLUMN` to its values, by time."""

STEP_MM = 20.0
"""A step of the raw disparity at the farthest wall."""


@pytest.fixture(scope="module")
def columns(tmp_path_factory: pytest.TempPathFactory) -> Columns:
    """Two sets, exported and read."""
    home = tmp_path_factory.mktemp("rerun")
    panoramas = [box_panorama(k) for k in range(2)]
    take = write_take(home / "take.mcap", box_description(), panoramas, box_calibration())
    rerun.export(export_job(take, home / "take.rrd"))
    return read(home / "take.rrd")


def read(path: Path) -> Columns:
    columns: dict[str, list[Any]] = {}
    chunks = RrdReader(str(path)).stream().to_chunks()
    for chunk in sorted(chunks, key=_frame_of):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            columns.setdefault(f"{chunk.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    return columns


def _frame_of(chunk: Any) -> int:
    return -1 if chunk.is_static else chunk.to_record_batch().column("frame").to_pylist()[0]


def lens_of(columns: Columns, entity: str) -> np.ndarray:
    """K of a pinhole; Rerun keeps matrices by columns."""
    (values,) = columns[f"{entity} Pinhole:image_from_camera"]
    return np.array(values[0]).reshape(3, 3).T


def pose_of(columns: Columns, entity: str) -> Pose:
    """T_parent_entity; a transform without a relation is one to the parent."""
    assert f"{entity} Transform3D:relation" not in columns
    T = np.eye(4)
    T[:3, :3] = np.array(columns[f"{entity} Transform3D:mat3x3"][0][0]).reshape(3, 3).T
    T[:3, 3] = columns[f"{entity} Transform3D:translation"][0][0]
    return T


def picture(columns: Columns, entity: str, k: int) -> np.ndarray:
    assert columns[f"{entity} EncodedImage:media_type"][k] == ["image/jpeg"]
    data = np.array(columns[f"{entity} EncodedImage:blob"][k][0], np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert image is not None
    return image.astype(float)


def depth_mm(columns: Columns, name: str) -> np.ndarray:
    entity = f"/rig/{name}/depth/image"
    assert columns[f"{entity} DepthImage:meter"][0] == [1000.0]
    data = np.array(columns[f"{entity} DepthImage:buffer"][0][0], np.uint8)
    return np.frombuffer(data.tobytes(), "<u2").reshape(DEPTH.height, DEPTH.width)


@pytest.mark.parametrize("k", [0, 1])
def test_colour_is_the_cameras_with_red_and_blue_in_their_places(columns: Columns, k: int) -> None:
    shown, sent = picture(columns, "/rig/cam01/color", k), box_frame(1, k).color
    assert sent is not None
    assert np.abs(shown - sent).mean() < 1.0
    assert np.abs(shown[..., ::-1] - sent).mean() > 10.0, "the scene tells red from blue"


def test_depth_is_in_millimetres_and_says_so(columns: Columns) -> None:
    raw = box_frame(2, 0).raw
    assert raw is not None
    expected_mm = MODEL.raw_model.numerator_m * 1e3 / (MODEL.raw_model.offset - raw.astype(float))
    assert np.abs(depth_mm(columns, "cam02") - expected_mm).max() <= 0.5


@pytest.mark.parametrize("pixel", [(40, 30), (80, 60), (110, 85)])
@pytest.mark.parametrize("camera_id", POSES)
def test_a_point_of_the_room_falls_on_its_pixel_through_the_tree(
    columns: Columns, camera_id: int, pixel: tuple[int, int]
) -> None:
    entity = f"/rig/cam{camera_id:02d}"
    point, _ = wall_point(camera_id, pixel)
    T_rig_camera = pose_of(columns, entity)
    # Rerun knows no distortion: the lens's own comes on top of its K.
    seen, _ = seen_by(T_rig_camera, lens_of(columns, f"{entity}/color"), np.array(MODEL.color.dist), point)
    assert np.abs(seen - pixel).max() < 1e-2
    T_rig_depth = T_rig_camera @ pose_of(columns, f"{entity}/depth")
    K_depth = lens_of(columns, f"{entity}/depth/image")
    (column, row), depth_m = seen_by(T_rig_depth, K_depth, np.zeros(5), point)
    measured_mm = depth_mm(columns, entity.removeprefix("/rig/"))[round(row), round(column)]
    assert abs(measured_mm - depth_m * 1e3) < STEP_MM


def test_lenses_tell_the_size_of_their_images(columns: Columns) -> None:
    lenses: dict[str, Intrinsics] = {"color": MODEL.color, "depth/image": DEPTH}
    for place, lens in lenses.items():
        (resolution,) = columns[f"/rig/cam00/{place} Pinhole:resolution"]
        assert resolution[0] == [lens.width, lens.height]


def test_the_cloud_lies_on_the_walls_in_their_colours(columns: Columns) -> None:
    points = np.array(columns["/rig/cloud Points3D:positions"][0])
    packed = np.array(columns["/rig/cloud Points3D:colors"][0], np.uint32)  # 0xRRGGBBAA
    colors = np.column_stack([(packed >> shift) & 255 for shift in (24, 16, 8)]).astype(float)
    assert len(points) > 500
    assert np.median(ROOM.wall_error_m(points)) < 0.01
    assert np.median(np.abs(colors - ROOM.colors(points))) < 4
    assert np.median(np.abs(colors[:, ::-1] - ROOM.colors(points))) > 10


def test_every_set_has_a_panorama(columns: Columns) -> None:
    assert len(columns["/panorama EncodedImage:blob"]) == 2
    assert picture(columns, "/panorama", 0).max() > 60


def test_timelines_are_the_frame_rig_time_and_unix_time(columns: Columns) -> None:
    assert columns["/rig/cam02/color frame"] == [0, 1]
    for k in range(2):
        rig_ns = columns["/rig/cam02/color rig_time"][k]
        utc = columns["/rig/cam02/color utc"][k]
        assert np.timedelta64(rig_ns, "ns") == np.timedelta64(CREATED_NS + k * PERIOD_NS + 2_000_000, "ns")
        unix_ns = np.datetime64(utc.replace(tzinfo=None), "ns").astype(np.int64)
        assert unix_ns == CREATED_UNIX_NS + k * PERIOD_NS + 2_000_000
    assert not any("log_time" in name or "log_tick" in name for name in columns)


def test_a_full_disk_is_told_before_rerun_meets_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = write_take(tmp_path / "take.mcap", box_description(), [box_panorama(0)], box_calibration())
    full = shutil._ntuple_diskusage(10**9, 10**9 - 4096, 4096)  # type: ignore[attr-defined]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    with pytest.raises(RigError, match="nearly full"):
        rerun.export(export_job(take, tmp_path / "take.rrd"))
    assert [path.name for path in tmp_path.iterdir()] == ["take.mcap"]


def test_the_room_stands_upright(columns: Columns) -> None:
    (axes,) = columns["/rig ViewCoordinates:xyz"]
    forward, left, up = 5, 4, 1  # rerun.datatypes.ViewDir
    assert list(axes[0]) == [forward, left, up]
