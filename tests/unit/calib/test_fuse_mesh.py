"""From a capture to mesh.ply and mesh.glb: the same whoever works on it; clear words where it cannot be."""

import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rig_calib.cli import main
from rig_calib.offline.capture import open_capture
from rig_calib.offline.workers import Batch, Result, Tell, ThisProcess
from rig_calib.tsdf import fusing
from rig_calib.tsdf.fusing import fuse_capture
from rig_calib.tsdf.volume import Volume
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing, write_rig_folder
from support.box_room import MODEL, BoxRoom, calibration_of, ring_poses
from support.box_takes import box_calibration, box_description, box_panorama, write_take

POSES = ring_poses(3)
CALIBRATION = calibration_of(POSES)
VOXEL_M = 0.03
FRAMES = 5


def write_capture(folder: Path, depth: bool = True) -> Path:
    entries = tuple(CameraEntry(c, f"cam{c:02d}", MODEL, T) for c, T in POSES.items())
    frames = []
    for c, T in POSES.items():
        view = BoxRoom().view(c, T)
        clean_mm = view.depth_mm[0].astype(np.int64)
        for k in range(FRAMES):
            noise = np.random.default_rng(c * FRAMES + k).integers(-3, 4, clean_mm.shape)
            depth_mm = (clean_mm + noise).astype(np.uint16) if depth else None
            frames.append(RgbdFrame(c, k, 0, color=view.color[0], depth_mm=depth_mm, depth_frame="color"))
    write_rig_folder(folder, RigDescription(entries, RingDrawing()), frames)
    CALIBRATION.save(folder / "calibration.json")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("capture"))


class Elsewhere(ThisProcess):
    """Workers who are sent everything as bytes, and whose last batch is ready first."""

    def map(
        self, work: Callable[[Batch], Result], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Result]:
        def sent(batch: Batch) -> Result:
            there, that = pickle.loads(pickle.dumps((work, batch)))  # noqa: S301 - our own bytes
            return pickle.loads(pickle.dumps(there(that)))  # type: ignore[no-any-return]  # noqa: S301

        return iter(list(super().map(sent, batches[::-1], tell)))


def fused(folder: Path, workers: ThisProcess, told: list[float] | None = None) -> Volume:
    capture = open_capture(folder)
    tell = (lambda _share: None) if told is None else told.append
    return fuse_capture(capture, CALIBRATION, {}, VOXEL_M, workers, tell)


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["rig-calib", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_batches_in_any_order_give_the_same_bits(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusing, "FRAMES_A_BATCH", 2)
    told: list[float] = []
    one, other = fused(folder, ThisProcess(), told), fused(folder, Elsewhere())
    np.testing.assert_array_equal(one.keys, other.keys)
    for own, others in zip(one.sums, other.sums, strict=True):
        np.testing.assert_array_equal(own, others)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_all_frames_count_however_they_are_batched(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fused(folder, ThisProcess())
    monkeypatch.setattr(fusing, "FRAMES_A_BATCH", 2)
    parts = fused(folder, ThisProcess())
    seen = np.intersect1d(whole.keys, parts.keys)
    weights = [v.sums.weight[np.searchsorted(v.keys, seen)].astype(float) for v in (whole, parts)]
    both = (weights[0] > 0) & (weights[1] > 0)
    assert np.median(weights[1][both] / weights[0][both]) == pytest.approx(1.0, abs=0.05)


def test_the_command_writes_both_files_of_the_room(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--calibration", folder / "calibration.json", "--out", tmp_path, "--mesh", "--voxel-mm", 30)
    assert run(monkeypatch, "fuse", folder, *words, "--workers", 1) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "triangles" in said
    assert "rims" in said
    assert (tmp_path / "cloud.ply").exists()
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    assert np.median(BoxRoom().wall_error_m(mesh.vertices)) < 2e-3  # noise of 2 mm, five frames averaged
    np.testing.assert_allclose(
        mesh.visual.vertex_colors[::50, :3], BoxRoom().colors(mesh.vertices[::50]), atol=12
    )
    upright = trimesh.load_scene(tmp_path / "mesh.glb").to_geometry()
    half_m = BoxRoom().half_size_m
    assert abs(upright.bounds[:, 1]).max() == pytest.approx(half_m[2], abs=0.05)  # y is up in glTF


def test_a_take_gives_a_mesh_by_the_calibration_that_it_carries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = write_take(
        tmp_path / "take.mcap", box_description(), [box_panorama(k) for k in range(2)], box_calibration()
    )
    assert run(monkeypatch, "fuse", take, "--out", tmp_path / "out", "--mesh", "--workers", 1) == 0
    mesh = trimesh.load_mesh(tmp_path / "out" / "mesh.ply", process=False)
    assert len(mesh.faces) > 10_000
    assert np.median(BoxRoom().wall_error_m(mesh.vertices)) < 3e-3  # disparity was rounded to whole steps
    expected = BoxRoom().colors(mesh.vertices) - 2.5  # the second of two frames is 5 darker
    assert np.median(np.abs(mesh.visual.vertex_colors[:, :3] - expected)) < 2


def test_a_mesh_is_made_of_the_frames_of_its_cloud(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a take whose cameras came one by one that are the complete ones, not the first."""
    first = [PanoramicFrame.of(k, {0: box_panorama(k).frames[0], 1: None, 2: None}) for k in range(6)]
    sets = [*first, box_panorama(6), box_panorama(7)]
    take = write_take(tmp_path / "take.mcap", box_description(), sets, box_calibration())
    words = ("--out", tmp_path, "--mesh", "--workers", 1, "--frames", 2, "--voxel-mm", 30)
    assert run(monkeypatch, "fuse", take, *words) == 0
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    cloud = trimesh.load(tmp_path / "cloud.ply").vertices
    np.testing.assert_allclose(mesh.bounds, [cloud.min(axis=0), cloud.max(axis=0)], atol=0.1)


def test_without_mesh_none_is_written(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("--calibration", folder / "calibration.json", "--out", tmp_path)
    assert run(monkeypatch, "fuse", folder, *words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloud.ply", "panorama.png"]


def test_a_library_that_is_missing_is_named_before_any_work(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "skimage", None)
    out = tmp_path / "out"
    words = ("--calibration", folder / "calibration.json", "--out", out, "--mesh")
    assert run(monkeypatch, "fuse", folder, *words) == 2
    assert "pip install 'kinect-rig[mesh]'" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_a_capture_without_depth_has_no_surface_and_is_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_capture(tmp_path / "colour", depth=False)
    words = ("--calibration", folder / "calibration.json", "--out", tmp_path / "out", "--mesh")
    assert run(monkeypatch, "fuse", folder, *words, "--workers", 1) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "there is no surface" in told
    assert "Traceback" not in told
    assert not (tmp_path / "out" / "mesh.ply").exists()


def test_cameras_without_a_pose_make_no_surface(folder: Path) -> None:
    capture = open_capture(folder)
    nobody = replace(CALIBRATION, cameras=())
    with pytest.raises(DataError, match="no camera that has a pose"):
        fuse_capture(capture, nobody, {}, VOXEL_M, ThisProcess())


@pytest.mark.parametrize("voxel_m", [0.0, -0.01, 0.0005, 5.0, float("nan")])
def test_a_voxel_out_of_reason_is_refused(folder: Path, voxel_m: float) -> None:
    capture = open_capture(folder)
    with pytest.raises(ConfigurationError, match="take 2 to 100 mm"):
        fuse_capture(capture, CALIBRATION, {}, voxel_m, ThisProcess())
