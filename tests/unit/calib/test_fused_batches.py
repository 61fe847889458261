"""Batches of a capture fused: what one fusion gives, from one set of tables, whoever asks."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

from rig_calib.frame_exports.fused_batches import borrowed_fusion, fused_batch, settings_of
from rig_calib.frame_exports.job import ExportJob, FusionLook
from rig_calib.fusion.live import LiveFusion, LiveFusionSettings
from rig_calib.offline.capture import Capture, open_capture
from rig_calib.offline.workers import Batch, ThisProcess, batches_of
from support.box_room import MODEL, calibration_of, ring_poses
from support.room_capture import write_room_capture

POSES = ring_poses(3)
CALIBRATION = calibration_of(POSES)
SMALL = LiveFusionSettings(depth_frame="color", circle_px=360, threads=1)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return open_capture(write_room_capture(tmp_path_factory.mktemp("room") / "capture"))


def panoramas_of(batch: Batch) -> list[np.ndarray]:
    return [fused.panorama.copy() for _, fused in fused_batch(batch, CALIBRATION, SMALL)]


def test_batches_give_what_one_fusion_gives_frame_by_frame(capture: Capture) -> None:
    with LiveFusion(CALIBRATION, dict.fromkeys(POSES, MODEL), SMALL) as fusion:
        expected = [fusion.fuse(one).panorama.copy() for one in capture.read(range(3))]
    got = [image for batch in batches_of(capture, range(3), 2) for image in panoramas_of(batch)]
    np.testing.assert_array_equal(got, expected)
    assert not np.array_equal(got[0], got[1])


def test_the_depth_images_own_camera_is_found_where_no_settings_tell(capture: Capture) -> None:
    [(_, fused)] = fused_batch(Batch(capture, range(1)), CALIBRATION)
    assert not fused.skipped
    assert len(fused.points_m)


def test_tables_are_made_once_for_all_batches_of_the_same_content(capture: Capture) -> None:
    with borrowed_fusion(capture, CALIBRATION, SMALL) as first:
        pass
    with borrowed_fusion(capture, calibration_of(ring_poses(3)), SMALL) as again:
        assert again is first
    with borrowed_fusion(capture, calibration_of(ring_poses(2)), SMALL) as other:
        assert other.camera_ids == (0, 1)


def test_two_threads_of_a_process_never_share_a_fusion(capture: Capture) -> None:
    both_hold_one = Barrier(2, timeout=60)

    def borrowed(_: int) -> LiveFusion:
        with borrowed_fusion(capture, CALIBRATION, SMALL) as fusion:
            both_hold_one.wait()
            return fusion

    with ThreadPoolExecutor(2) as pool:
        one, other = pool.map(borrowed, range(2))
    assert one is not other


def test_a_batch_that_nobody_reads_to_its_end_hinders_no_other(capture: Capture) -> None:
    with closing(fused_batch(Batch(capture, range(3)), CALIBRATION, SMALL)) as batch:
        next(batch)
    assert len(panoramas_of(Batch(capture, range(3)))) == 3


def test_cameras_of_different_exposure_are_matched_where_a_job_asks_for_it(tmp_path: Path) -> None:
    capture = open_capture(write_room_capture(tmp_path / "dark", 1, exposures={1: 0.5}))
    job = ExportJob(capture, range(1), tmp_path, ThisProcess(), CALIBRATION)
    assert not settings_of(job).gains
    gains = settings_of(replace(job, look=FusionLook(match_colors=True))).gains
    for neighbour in (0, 2):
        np.testing.assert_allclose(gains[1] / gains[neighbour], 2.0, rtol=0.1)


def test_cameras_that_come_later_are_matched_too(tmp_path: Path) -> None:
    path = write_room_capture(tmp_path / "dark", 2, exposures={1: 0.5})
    for image in (path / "cam01").glob("*_000.png"):
        image.unlink()
    job = ExportJob(open_capture(path), range(2), tmp_path, ThisProcess(), CALIBRATION)
    gains = settings_of(replace(job, look=FusionLook(match_colors=True))).gains
    assert gains.keys() == {0, 1, 2}
    np.testing.assert_allclose(gains[1] / gains[0], 2.0, rtol=0.1)


def test_a_jobs_panorama_is_seen_from_where_it_says(capture: Capture, tmp_path: Path) -> None:
    job = ExportJob(capture, range(1), tmp_path, ThisProcess(), CALIBRATION, look=FusionLook((0.5, 0.0, 0.2)))
    with borrowed_fusion(capture, CALIBRATION, settings_of(job)) as fusion:
        np.testing.assert_allclose(fusion.T_rig_view[:3, 3], (0.5, 0.0, 0.2))
