"""The fusing sink: the calibration in force, nothing that outlives its time, and trouble in a sentence."""

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from rig_calib.fusion.live import FusedFrame, LiveFusionSettings
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription
from rig_server.sinks.fuse import FuseSink
from support.box_room import MODEL, BoxRoom, calibration_of, ring_poses

POSES = ring_poses(2)
SETTINGS = LiveFusionSettings(circle_px=360)


def frame_of(camera_id: int) -> RgbdFrame:
    view = BoxRoom().view(camera_id, POSES[camera_id])
    return RgbdFrame(camera_id, 0, 0, color=view.color[0], depth_mm=view.depth_mm[0], depth_frame="color")


PANORAMA = PanoramicFrame.of(0, {camera_id: frame_of(camera_id) for camera_id in POSES})


KNOWN = calibration_of(POSES)


def described(model: CameraModel = MODEL) -> RigDescription:
    return RigDescription(tuple(CameraEntry(i, f"cam{i:02d}", model) for i in POSES))


@dataclass
class Bench:
    """A sink, and what it was given and gave."""

    calibration: RigCalibration | None = field(default_factory=lambda: calibration_of(POSES))
    description: RigDescription = field(default_factory=described)
    clouds: list[np.ndarray] = field(default_factory=list)
    skipped: list[tuple[str, ...]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.fused, self.asked = threading.Semaphore(0), threading.Semaphore(0)
        self.sink = FuseSink(self.in_force, lambda: self.description, self.take, settings=SETTINGS)
        self.sink.start()

    def in_force(self) -> RigCalibration | None:
        self.asked.release()
        return self.calibration

    def take(self, frame: FusedFrame) -> None:
        self.clouds.append(frame.points_m.copy())
        self.skipped.append(frame.skipped)
        self.fused.release()

    def fuse(self, panorama: PanoramicFrame = PANORAMA) -> np.ndarray:
        self.sink.offer(panorama)
        assert self.fused.acquire(timeout=120), self.sink.report()
        return self.clouds[-1]


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.sink.stop()


def test_the_cloud_lies_on_the_walls_wherever_the_depth_images_live(bench: Bench) -> None:
    points = bench.fuse()
    assert len(points) > 10_000
    assert np.median(BoxRoom().wall_error_m(points)) < 0.01


def test_it_follows_the_calibration_that_is_put_in_force(bench: Bench) -> None:
    before = bench.fuse()
    raised = {camera_id: T.copy() for camera_id, T in POSES.items()}
    for T in raised.values():
        T[2, 3] += 1.0
    bench.calibration = calibration_of(raised)
    after = bench.fuse()
    assert np.median(after[:, 2]) - np.median(before[:, 2]) == pytest.approx(1.0, abs=0.01)


def test_without_a_calibration_nothing_is_fused_and_nothing_is_wrong(bench: Bench) -> None:
    bench.calibration = None
    bench.sink.offer(PANORAMA)
    assert bench.asked.acquire(timeout=10)
    bench.calibration = calibration_of(POSES)
    bench.fuse()
    assert len(bench.clouds) == 1
    assert bench.sink.report().trouble is None


def test_a_calibration_of_another_rig_is_a_sentence_and_not_the_end(bench: Bench) -> None:
    bench.calibration = calibration_of({7: POSES[0]})
    bench.sink.offer(PANORAMA)
    assert bench.asked.acquire(timeout=10)
    bench.calibration = calibration_of(POSES)
    bench.sink.offer(PANORAMA)
    assert bench.fused.acquire(timeout=120)
    bench.calibration = calibration_of({7: POSES[0]})
    bench.sink.offer(PANORAMA)
    bench.sink.stop()  # when the last set was taken
    assert len(bench.clouds) == 1


def test_what_cannot_be_fused_is_told_in_a_sentence() -> None:
    bench = Bench(calibration=calibration_of({7: POSES[0]}))
    told = threading.Event()
    bench.sink.offer(PANORAMA)
    while bench.sink.report().trouble is None:
        assert not told.wait(0.01)
    bench.sink.stop()
    assert "nothing can be fused" in (bench.sink.report().trouble or "")


def test_a_missing_camera_is_named(bench: Bench) -> None:
    lacking = replace(PANORAMA, frames={**PANORAMA.frames, 1: None})
    bench.fuse(lacking)
    assert bench.skipped == [("camera 1: left out, it delivered nothing",)]
    assert bench.sink.report().skipped == bench.skipped[0]


def test_a_set_that_lacks_cameras_gives_way_to_a_full_one_of_the_same_second(bench: Bench) -> None:
    lacking = replace(PANORAMA, frames={**PANORAMA.frames, 1: None})
    bench.fuse()
    bench.sink.offer(lacking)
    bench.fuse()
    assert bench.skipped == [(), ()]


def test_colours_are_matched_where_it_is_asked_for() -> None:
    dark = frame_of(1)
    assert dark.color is not None
    panorama = PanoramicFrame.of(0, {**PANORAMA.frames, 1: replace(dark, color=dark.color // 2)})
    means: queue.Queue[np.ndarray] = queue.Queue()

    def take(frame: FusedFrame) -> None:
        owner = np.repeat(frame.camera_ids, np.diff(frame.starts))
        means.put(frame.colors[owner == 1].mean(axis=0))

    seen = []
    for match in (False, True):
        sink = FuseSink(lambda: KNOWN, described, take, settings=SETTINGS, match_colors=match)
        sink.start()
        sink.offer(panorama)
        seen.append(means.get(timeout=120))
        sink.stop()
    assert (seen[1] > 1.3 * seen[0]).all()
