"""Rules of the calibration in force: one for everybody; takes embed it, and bring it when replayed."""

import logging
import threading
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from mcap.reader import make_reader

from rig_calib.recorded_calibration import calibration_for
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.recorder import TakeContext
from rig_protocol.recording import CALIBRATION, Recording
from rig_server import Rig
from rig_server.config import RigSettings, WatchSettings
from rig_server.replay import ReplayOptions
from rig_server.sinks.record import RecordSink
from support.box_room import calibration_of, ring_poses
from support.small_agent import SmallAgent
from support.takes import SETTINGS

FIRST, SECOND = (calibration_of(ring_poses(2), created=f"2026-01-0{day}T00:00:00+00:00") for day in (1, 2))
FASTEST = ReplayOptions(speed=None)


class FakeWatch:
    """In place of the drift watch: remembers what became of it."""

    made: list["FakeWatch"]

    def __init__(self, calibration: RigCalibration, every: int) -> None:
        self.calibration, self.every = calibration, every
        self.state, self.offered = "made", 0
        FakeWatch.made.append(self)

    def start(self) -> None:
        self.state = "started"

    def stop(self) -> None:
        self.state = "stopped"

    def offer(self, *_: object) -> None:
        self.offered += 1

    def report(self) -> RigCalibration:
        return self.calibration


@pytest.fixture
def watches(monkeypatch: pytest.MonkeyPatch) -> list[FakeWatch]:
    FakeWatch.made = []
    monkeypatch.setattr("rig_server.rig.WatchSink", FakeWatch)
    return FakeWatch.made


class Feed(Mock):
    """A feed that gives the same set for ever."""

    def __init__(self, **fields: Any) -> None:
        super().__init__(**fields)
        self.calibration: RigCalibration | None = None

    def next_panorama(self, _timeout_s: float) -> PanoramicFrame:
        return PanoramicFrame(0, 0, {}, 0)


def test_nobody_watches_where_nobody_asked_whatever_is_in_force(watches: list[FakeWatch]) -> None:
    with Rig(Feed(), RigSettings()) as rig:
        assert rig.calibration is None
        rig.put_in_force(FIRST)
        rig.next_panorama(0.0)
        assert rig.calibration is FIRST
    assert watches == []


def test_the_settings_calibration_is_in_force_and_watched_over(
    watches: list[FakeWatch], tmp_path: Path
) -> None:
    FIRST.save(tmp_path / "calibration.json")
    settings = RigSettings(watch=WatchSettings(calibration=tmp_path / "calibration.json", every=7))
    with Rig(Feed(), settings) as rig:
        assert rig.calibration is not None
        assert rig.calibration.created == FIRST.created
        rig.next_panorama(0.0)
        assert [(watch.state, watch.every, watch.offered) for watch in watches] == [("started", 7, 1)]
    assert watches[0].state == "stopped"
    (tmp_path / "calibration.json").write_text("{}")
    with pytest.raises(ConfigurationError, match=r"watch\.calibration: .*schema"):
        Rig(Feed(), settings)


def test_another_calibration_in_force_is_the_one_that_is_watched_over(watches: list[FakeWatch]) -> None:
    feed = Feed()
    with Rig(feed, RigSettings()) as rig:
        rig.put_in_force(FIRST, watch=True)
        rig.next_panorama(0.0)
        rig.put_in_force(SECOND)  # a watch that runs goes on with it, unasked
        rig.next_panorama(0.0)
        assert [watch.calibration for watch in watches] == [FIRST, SECOND]
        assert [watch.state for watch in watches] == ["stopped", "started"]
        assert [watch.offered for watch in watches] == [1, 1]
        assert feed.calibration is rig.calibration is SECOND


def test_a_watch_that_is_asked_for_before_the_rig_begins_begins_with_it(watches: list[FakeWatch]) -> None:
    rig = Rig(Feed(), RigSettings())
    rig.put_in_force(FIRST, watch=True)
    assert watches[0].state == "made"
    with rig:
        assert watches[0].state == "started"


def record(path: Path, *in_force: Any) -> None:
    """Two cameras, while one calibration after the other is in force."""
    with Rig.live(SETTINGS, record=path) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        with SmallAgent(0, (host, int(port))), SmallAgent(1, (host, int(port))):
            rig.wait_for_cameras(30)
            for calibration in (*in_force, None):
                if calibration is not None:
                    rig.put_in_force(calibration)
                for _, _panorama in zip(range(3), rig, strict=False):
                    pass


def test_a_take_brings_the_calibration_that_was_last_in_force_while_it_ran(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    record(take, FIRST, SECOND)
    brought = calibration_for(take, None)
    assert brought.created == SECOND.created
    assert all(np.array_equal(brought.poses[i], SECOND.poses[i]) for i in SECOND.poses)
    with Rig.replayed(take, RigSettings(), FASTEST) as rig:
        assert rig.calibration is not None
        assert rig.calibration.created == SECOND.created
    FIRST.save(tmp_path / "other.json")
    assert calibration_for(take, tmp_path / "other.json").created == FIRST.created, "a file named counts more"


def test_what_follows_the_last_set_still_gets_into_the_take(tmp_path: Path) -> None:
    """`--calibrate --record`: the result comes when no set is needed any more."""
    take = tmp_path / "take.mcap"
    with Rig.live(SETTINGS, record=take) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        with SmallAgent(0, (host, int(port))), SmallAgent(1, (host, int(port))):
            rig.wait_for_cameras(30)
            assert rig.next_panorama(30.0) is not None
        rig.end_sets()
        rig.put_in_force(FIRST)
    recording = Recording(take)
    assert recording.torn == ()
    assert calibration_for(take, None).created == FIRST.created


def test_a_take_without_a_calibration_says_what_to_do(tmp_path: Path) -> None:
    record(tmp_path / "take.mcap")
    with Rig.replayed(tmp_path / "take.mcap", RigSettings(), FASTEST) as rig:
        assert rig.calibration is None
    for capture in (tmp_path / "take.mcap", tmp_path):
        with pytest.raises(ConfigurationError, match="--calibration FILE"):
            calibration_for(capture, None)


def test_a_take_plays_without_a_calibration_that_cannot_be_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class OfAnotherRelease:
        def to_dict(self) -> dict[str, int]:
            return {"schema": 99}

    take = tmp_path / "take.mcap"
    record(take, OfAnotherRelease())
    with caplog.at_level(logging.WARNING), Rig.replayed(take, RigSettings(), FASTEST) as rig:
        assert rig.calibration is None
        assert len(list(rig)) > 0
    assert "not a calibration of schema 1" in caplog.text
    with pytest.raises(DataError, match=r"take\.mcap: calibration\.json: not a calibration of schema 1"):
        calibration_for(take, None)


def test_a_document_is_written_again_only_when_it_is_another_one(tmp_path: Path) -> None:
    documents = {CALIBRATION: {"day": 1}}
    asked = threading.Semaphore(0)

    def ask() -> dict[str, Any]:
        asked.release()
        return dict(documents)

    sink = RecordSink(tmp_path / "take.mcap", RigSettings().recording, TakeContext(ask))
    sink.start()
    for _ in range(2):
        assert asked.acquire(timeout=30)
    documents[CALIBRATION] = {"day": 2}
    sink.stop()
    with (tmp_path / "take.mcap").open("rb") as file:
        found = [one.data for one in make_reader(file).iter_attachments() if one.name == CALIBRATION]
    assert len(found) == 2
    assert Recording(tmp_path / "take.mcap").document(CALIBRATION) == {"day": 2}
