"""Clouds and panoramas in other programs' formats: their own libraries read what the fusion gave."""

import json
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import laspy
import numpy as np
import OpenEXR
import plyfile
import pye57
import pytest
from pypcd4 import PointCloud

from rig_calib.frame_exports import frame_files, ply, video
from rig_calib.frame_exports.formats import FORMATS
from rig_calib.frame_exports.fused_batches import borrowed_fusion, fused_batch
from rig_calib.frame_exports.job import ExportJob
from rig_calib.frame_exports.panorama_geometry import panorama_geometry
from rig_calib.fusion.live import LiveFusionSettings
from rig_calib.offline.workers import Batch, Tell
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.poses import Pose, transform_points
from support.box_room import calibration_of
from support.box_takes import (
    CREATED_NS,
    CREATED_UNIX_NS,
    MODEL,
    PERIOD_NS,
    POSES,
    box_calibration,
    box_description,
    box_panorama,
    export_job,
    write_take,
)
from support.room_capture import write_room_capture

INDICES = (5, 6, 8)  # set 7 never came, so frames 5 and 6 are nearer in time than 6 and 8
ABSENT = "camera 2: left out, it delivered nothing (1 of 3 panoramic frames)"


@dataclass(frozen=True)
class Fused:
    """What the fusion gave of one panoramic frame, kept."""

    points_m: np.ndarray
    colors: np.ndarray
    owner: np.ndarray
    panorama: np.ndarray
    depth_m: np.ndarray


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three panoramic frames of three cameras; the last lacks camera 2."""
    panoramas = [box_panorama(index) for index in INDICES]
    last = PanoramicFrame.of(INDICES[-1], {**panoramas[-1].frames, 2: None})
    folder = tmp_path_factory.mktemp("take")
    return write_take(folder / "hall.mcap", box_description(), [*panoramas[:-1], last], box_calibration())


@pytest.fixture(scope="module")
def fused(take: Path) -> Mapping[int, Fused]:
    """By index of the panoramic frame."""
    job = export_job(take, Path())
    found = {}
    for _, one in fused_batch(Batch(job.capture, job.positions), job.needed_calibration()):
        owner = np.repeat(one.camera_ids, np.diff(one.starts))
        arrays = (one.points_m, one.colors, owner, one.panorama, one.panorama_depth_m)
        found[one.index] = Fused(*(array.copy() for array in arrays))
    return found


@pytest.fixture
def exported(take: Path, tmp_path: Path) -> Callable[[str], Path]:
    """The folder with the files of all frames in a format."""

    def export(form: str) -> Path:
        made = FORMATS[form].exporter()(export_job(take, tmp_path / form))
        assert made.paths == (tmp_path / form,)
        assert made.notes == (ABSENT,)
        return tmp_path / form

    return export


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def clouds_in(folder: Path, suffix: str) -> dict[int, Path]:
    assert names(folder) == [f"cloud_{index:06d}{suffix}" for index in INDICES]
    return {index: folder / f"cloud_{index:06d}{suffix}" for index in INDICES}


def test_plyfile_reads_points_and_colours_of_a_ply(
    exported: Callable[[str], Path], fused: Mapping[int, Fused]
) -> None:
    for index, path in clouds_in(exported("ply"), ".ply").items():
        vertices = plyfile.PlyData.read(path)["vertex"]
        points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
        colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)
        np.testing.assert_array_equal(points, fused[index].points_m)
        np.testing.assert_array_equal(colors, fused[index].colors)


def test_a_pcd_has_the_header_of_pcl_and_pypcd4_reads_points_and_colours(
    exported: Callable[[str], Path], fused: Mapping[int, Fused]
) -> None:
    for index, path in clouds_in(exported("pcd"), ".pcd").items():
        data, count = path.read_bytes(), len(fused[index].points_m)
        for line in ("FIELDS x y z rgb", "SIZE 4 4 4 4", "TYPE F F F F", f"POINTS {count}", "DATA binary"):
            assert f"\n{line}\n".encode() in data[:400]
        # Read without any library: PCL's rows are 16 bytes, the colour's bytes blue, green, red.
        rows = np.frombuffer(data[-16 * count :], np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 4)]))
        np.testing.assert_array_equal(rows["xyz"], fused[index].points_m)
        np.testing.assert_array_equal(rows["bgr"][:, 2::-1], fused[index].colors)
        cloud = PointCloud.from_path(path)
        np.testing.assert_array_equal(cloud.numpy(("x", "y", "z")), fused[index].points_m)


def test_an_e57_has_a_scan_a_camera_that_stands_where_its_depth_camera_stood(
    exported: Callable[[str], Path], fused: Mapping[int, Fused]
) -> None:
    for index, path in clouds_in(exported("e57"), ".e57").items():
        expected = fused[index]
        with pye57.E57(str(path)) as e57:
            ids = sorted(set(expected.owner.tolist()))
            assert e57.scan_count == len(ids) == (2 if index == INDICES[-1] else 3)
            for k, camera_id in enumerate(ids):
                header, own = e57.get_header(k), expected.owner == camera_id
                assert header["name"].value() == f"cam{camera_id:02d}"
                np.testing.assert_allclose(
                    header.translation, (POSES[camera_id] @ MODEL.T_color_depth)[:3, 3], atol=1e-12
                )
                scan = e57.read_scan(k, colors=True)
                points = np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
                colors = np.stack([scan[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1)
                np.testing.assert_allclose(points, expected.points_m[own], atol=1e-6)
                np.testing.assert_array_equal(colors, expected.colors[own])


def test_the_bounds_of_an_e57_scan_are_those_of_its_own_frame(exported: Callable[[str], Path]) -> None:
    with pye57.E57(str(exported("e57") / "cloud_000005.e57")) as e57:
        raw, header = e57.read_scan_raw(1), e57.get_header(1)
        for axis in "xyz":
            points = raw[f"cartesian{axis.upper()}"]
            assert getattr(header, f"{axis}Minimum") == pytest.approx(points.min(), abs=1e-6)
            assert getattr(header, f"{axis}Maximum") == pytest.approx(points.max(), abs=1e-6)


def test_laspy_reads_a_las_to_a_tenth_of_a_millimetre_with_cameras_and_time(
    exported: Callable[[str], Path], fused: Mapping[int, Fused]
) -> None:
    for index, path in clouds_in(exported("las"), ".las").items():
        las, expected = laspy.read(path), fused[index]
        assert (str(las.header.version), las.point_format.id) == ("1.4", 7)
        np.testing.assert_allclose(las.xyz, expected.points_m, atol=0.51e-4)
        colors = np.stack([las.red, las.green, las.blue], axis=1)
        np.testing.assert_array_equal(colors, expected.colors.astype(np.uint16) * 257)
        np.testing.assert_array_equal(las.point_source_id, expected.owner)
        cameras = 2 if index == INDICES[-1] else 3
        exposure_ns = index * PERIOD_NS + (cameras - 1) * 500_000  # the cameras' mean, a millisecond apart
        gps_s = (CREATED_UNIX_NS + exposure_ns) * 1e-9 - 315_964_800 + 18
        assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
        np.testing.assert_allclose(las.gps_time + 1e9, gps_s, atol=1e-6)


def test_a_png_panorama_is_colour_depth_in_millimetres_and_its_geometry(
    exported: Callable[[str], Path], fused: Mapping[int, Fused]
) -> None:
    folder = exported("png")
    assert len(names(folder)) == 3 * len(INDICES)
    for index in INDICES:
        color = cv2.imread(str(folder / f"panorama_{index:06d}.png"), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(folder / f"panorama_depth_{index:06d}.png"), cv2.IMREAD_UNCHANGED)
        known = np.isfinite(fused[index].depth_m)
        np.testing.assert_array_equal(color, fused[index].panorama)
        assert depth.dtype == np.uint16
        np.testing.assert_allclose(depth[known], fused[index].depth_m[known] * 1e3, atol=0.501)
        assert not depth[~known].any()
        assert 0 < known.mean() < 1
        about = json.loads((folder / f"panorama_{index:06d}.json").read_text())
        assert (about["height"], about["width"]) == depth.shape
        assert about["utc_ns"] - about["timestamp_ns"] == CREATED_UNIX_NS - CREATED_NS


def test_opencv_reads_an_exr_and_its_attributes_make_points_of_its_pixels(
    exported: Callable[[str], Path], fused: Mapping[int, Fused]
) -> None:
    folder = exported("exr")
    assert names(folder) == [f"panorama_{index:06d}.exr" for index in INDICES]
    expected = fused[5]
    with OpenEXR.File(str(folder / "panorama_000005.exr"), separate_channels=True) as file:
        header = dict(file.header())
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    known = np.isfinite(expected.depth_m)
    assert np.isposinf(channels["Z"][~known]).all()
    np.testing.assert_array_equal(channels["Z"][known], expected.depth_m[known])
    for name, blue_green_red in zip("BGR", np.moveaxis(expected.panorama, 2, 0), strict=True):
        linear = channels[name].astype(np.float64)
        encoded = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
        np.testing.assert_array_equal(np.rint(encoded * 255), blue_green_red)
    points = points_of(header, channels["Z"])
    # Of every pixel of the panorama there is a point of the cloud nearby: one in a hundred is looked at.
    for point in points[:: len(points) // 100]:
        assert np.linalg.norm(expected.points_m - point, axis=1).min() < 0.06


def points_of(header: dict[str, object], depth_m: np.ndarray) -> np.ndarray:
    """Points (N,3) of the rig frame, from the attributes alone."""
    assert header["kinectRigProjection"] == "cylinder"
    rows, columns = np.nonzero(np.isfinite(depth_m))
    azimuth = header["kinectRigAzimuthLeft"] - columns * header["kinectRigRadiansPerPixel"]
    slope = header["kinectRigSlopeTop"] - rows * header["kinectRigRadiansPerPixel"]
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), slope], axis=1)
    T_rig_view: Pose = np.asarray(header["kinectRigView"], np.float64).reshape(4, 4)
    return transform_points(T_rig_view, rays * depth_m[rows, columns, None])


def decoded(path: Path) -> tuple[list[float], list[np.ndarray], dict[str, str], str]:
    """Seconds and images (BGR) of a video, its metadata, its codec."""
    with av.open(path) as file:
        frames = list(file.decode(video=0))
        stream = file.streams.video[0]
        images = [frame.to_ndarray(format="bgr24") for frame in frames]
        return [float(frame.time) for frame in frames], images, file.metadata, stream.codec_context.name


def test_a_matroska_video_is_the_panoramas_bit_for_bit_at_the_times_of_the_take(
    take: Path, tmp_path: Path, fused: Mapping[int, Fused]
) -> None:
    made = FORMATS["video"].exporter()(export_job(take, tmp_path / "hall.mkv"))
    seconds, images, metadata, codec = decoded(tmp_path / "hall.mkv")
    assert (made.notes, codec) == ((ABSENT,), "ffv1")
    for image, index in zip(images, INDICES, strict=True):
        np.testing.assert_array_equal(image, fused[index].panorama)
    # Frame 8 lacks the camera that exposed last: half a millisecond less. Matroska counts milliseconds.
    np.testing.assert_allclose(seconds, [0.0, 0.033, 0.099 - 0.0005], atol=0.0006)
    assert metadata["title"] == "Panorama of hall.mcap"


def test_an_mp4_video_is_h264_of_even_size_close_to_the_panoramas(
    take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A circle that fits the small cameras of the test: on a finer one their pixels would stand apart.
    coarse = LiveFusionSettings(circle_px=705)
    monkeypatch.setattr(video, "settings_of", lambda _job: coarse)
    job = export_job(take, tmp_path / "hall.mp4")
    video.export(job)
    seconds, images, metadata, codec = decoded(tmp_path / "hall.mp4")
    assert codec == "h264"
    assert json.loads(metadata["comment"])["projection"] == "cylinder"
    np.testing.assert_allclose(seconds, [0.0, 0.033, 0.0985], atol=1e-5)
    pairs = zip(
        images, fused_batch(Batch(job.capture, job.positions), box_calibration(), coarse), strict=True
    )
    for image, (_, one) in pairs:
        height, width = one.panorama.shape[:2]
        assert image.shape == (height + height % 2, width + width % 2, 3)
        assert (height % 2, width % 2) != (0, 0)
        # Of single pixels 4:2:0 loses the colour, of areas it does not.
        shown = cv2.blur(image[:height, :width].astype(float), (9, 9))
        expected = cv2.blur(one.panorama.astype(float), (9, 9))
        assert np.median(np.abs(shown - expected)[expected > 60]) < 1.5
        assert np.abs(expected[..., 0] - expected[..., 2]).mean() > 10


def test_the_frames_of_a_rig_folder_come_at_the_given_rate(tmp_path: Path) -> None:
    folder = write_room_capture(tmp_path / "room", frames=3)
    job = replace(export_job(folder, tmp_path / "room.mkv", box_calibration()), fps=10.0)
    FORMATS["video"].exporter()(job)
    assert decoded(tmp_path / "room.mkv")[0] == pytest.approx([0.0, 0.1, 0.2])


def test_a_video_begins_with_the_first_frame_that_can_be_read(tmp_path: Path) -> None:
    """However many come before it: here all that are drawn together."""
    panoramas, broken = [box_panorama(k) for k in range(6)], range(5)
    source = write_take(
        tmp_path / "take.mcap", box_description(), panoramas, box_calibration(), broken=broken
    )
    video.export(export_job(source, tmp_path / "hall.mkv"))
    assert len(decoded(tmp_path / "hall.mkv")[1]) == 1


def test_another_ending_of_a_video_is_refused(take: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"hall\.avi must end with \.mp4 .* or \.mkv"):
        FORMATS["video"].exporter()(export_job(take, tmp_path / "hall.avi"))


ONE_FILE = ["ply", "pcd", "e57", "las", "exr"]


def one_frame(take: Path, out: Path) -> ExportJob:
    return replace(export_job(take, out), positions=range(1, 2))


@pytest.mark.parametrize("form", ONE_FILE)
def test_a_single_frame_becomes_the_file_that_is_named(form: str, take: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / f"hall.{form}"
    FORMATS[form].check(out, 1)
    assert FORMATS[form].exporter()(one_frame(take, out)).paths == (out,)
    assert names(out.parent) == [out.name]
    assert out.is_file()


class PickledThreads:
    """Two threads that are given nothing but what another process would be."""

    def map(
        self, work: Callable[[Batch], Any], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Any]:
        """As `Workers.map`."""
        del tell
        sent = [pickle.dumps((work, batch)) for batch in batches]
        with ThreadPoolExecutor(2) as pool:
            yield from pool.map(self._done, sent)

    @staticmethod
    def _done(sent: bytes) -> Any:
        work, batch = pickle.loads(sent)  # noqa: S301  # its own
        return work(batch)


@pytest.mark.parametrize("form", ["ply", "pcd", "las", "png", "exr"])
def test_files_do_not_depend_on_who_writes_which(
    form: str, take: Path, exported: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = exported(form)
    monkeypatch.setattr(frame_files, "BATCH_FRAMES", 1)
    shared = tmp_path / "shared"
    made = FORMATS[form].exporter()(replace(export_job(take, shared), workers=PickledThreads()))
    assert made.notes == (ABSENT,)
    assert names(shared) == names(alone)
    for name in names(alone):
        assert (shared / name).read_bytes() == (alone / name).read_bytes()


def test_a_videos_frames_keep_their_order_whoever_draws_them(
    take: Path, tmp_path: Path, fused: Mapping[int, Fused], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "BATCH_FRAMES", 1)
    video.export(replace(export_job(take, tmp_path / "hall.mkv"), workers=PickledThreads()))
    for image, index in zip(decoded(tmp_path / "hall.mkv")[1], INDICES, strict=True):
        np.testing.assert_array_equal(image, fused[index].panorama)


@pytest.mark.parametrize("module", ["av", "laspy", "OpenEXR", "pye57", "pypcd4"])
def test_a_library_that_is_not_installed_is_told_with_what_brings_it(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    form = {"av": "video", "laspy": "las", "OpenEXR": "exr", "pye57": "e57", "pypcd4": "pcd"}[module]
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, f"{module}.{module}", None)
    monkeypatch.delitem(sys.modules, f"rig_calib.frame_exports.{form}", raising=False)
    with pytest.raises(ConfigurationError, match=rf"{module}.*kinect-rig\[exports\]"):
        FORMATS[form].exporter()


@pytest.mark.parametrize("form", ONE_FILE)
def test_several_frames_do_not_go_into_one_file(form: str) -> None:
    with pytest.raises(ConfigurationError, match=f"hall.{form} is one file, .* name a folder"):
        FORMATS[form].check(Path(f"hall.{form}"), 2)


@pytest.mark.parametrize("out", ["hall.las", "hall.mp4", "folder"])
def test_what_is_there_is_never_written_over(out: str, take: Path, tmp_path: Path) -> None:
    path = tmp_path / out
    kept = path if path.suffix else path / "cloud_000005.las"
    kept.parent.mkdir(exist_ok=True)
    kept.write_bytes(b"precious")
    form = "video" if path.suffix == ".mp4" else "las"
    with pytest.raises(ConfigurationError, match="exists and stays as it is"):
        FORMATS[form].exporter()(one_frame(take, path))
    assert kept.read_bytes() == b"precious"


@pytest.mark.parametrize("name", [*(f"hall.{form}" for form in ONE_FILE), "hall.mp4", "hall.mkv"])
def test_a_full_disk_is_told_in_a_sentence_and_leaves_nothing(name: str, take: Path, tmp_path: Path) -> None:
    (tmp_path / f"{name}.part").symlink_to("/dev/full")
    form = name.partition(".")[2]
    with pytest.raises(RigError, match=f"{name} could not be written"):
        FORMATS[form if form in ONE_FILE else "video"].exporter()(one_frame(take, tmp_path / name))
    assert not names(tmp_path)


def test_a_camera_that_the_calibration_could_not_place_is_told(take: Path, tmp_path: Path) -> None:
    first_two = calibration_of({i: POSES[i] for i in (0, 1)})
    job = export_job(take, tmp_path / "ply", first_two)
    assert ply.export(job).notes == ("cam02: left out, the calibration could not place it",)


def test_a_capture_without_calibration_says_what_to_do(take: Path, tmp_path: Path) -> None:
    job = replace(export_job(take, tmp_path / "out"), calibration=None)
    for form in ("ply", "png", "video"):
        out = tmp_path / "out.mp4" if form == "video" else tmp_path / form
        with pytest.raises(ConfigurationError, match="--calibration FILE"):
            FORMATS[form].exporter()(replace(job, out=out))
    assert not names(tmp_path)


def test_the_geometry_names_the_calibration_by_its_content(take: Path) -> None:
    job = export_job(take, Path())
    other = replace(box_calibration(), created="later")
    with borrowed_fusion(job.capture, box_calibration()) as fusion:
        ids = [panorama_geometry(fusion, one)["calibration"] for one in (box_calibration(), other)]
    assert ids[0] != ids[1]
