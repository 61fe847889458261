"""Rules of the recorder: it never holds up capture, loses whole frames only, and says what it lost."""

import errno
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from rig_protocol import recorder
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.recorder import RecordingStatus, TakeContext
from rig_protocol.recording import MANIFEST, Recording, part_paths, recover
from rig_protocol.recording_format import DroppedFrames, RecordedSet
from rig_protocol.take_file import TakeFile
from rig_server import Rig
from rig_server.config import RecordingSettings, RigSettings, SynchroniserSettings
from rig_server.metrics import RigStatus
from rig_server.replay import ReplayOptions
from rig_server.sinks.record import RecordSink
from rig_server.status_words import alarms, summary
from support.small_agent import BAYER, COLOR, RAW, SmallAgent
from support.takes import SETTINGS, same_set

KILLED = """
import sys, time
from pathlib import Path
from rig_protocol.frames import EncodedFrame, Payload
from rig_server.config import RecordingSettings
from rig_protocol.recorder import TakeContext
from rig_server.sinks.record import RecordSink
sink = RecordSink(Path(sys.argv[1]), RecordingSettings(), TakeContext())
sink.start()
for k in range(10_000):
    now = time.monotonic_ns()
    sink.add(EncodedFrame(0, k, now, color=Payload(1, bytes(1000)), received_ns=now))
    if k == 150:
        print("now", flush=True)
    time.sleep(0.01)
"""


def frame(k: int, size: int = 1000, camera_id: int = 0) -> EncodedFrame:
    return EncodedFrame(camera_id, k, k * 1000, color=Payload(1, bytes(size)), received_ns=k * 1000 + 5)


def sink_to(path: Path, **settings: object) -> RecordSink:
    return RecordSink(path, RecordingSettings.model_validate(settings), TakeContext())


class BlockedDisk:
    """Writes of entries wait until `release`; `reached` tells that one does."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self.release = threading.Event(), threading.Event()
        write = TakeFile.write

        def blocked(file: TakeFile, entry: EncodedFrame) -> None:
            self.reached.set()
            assert self.release.wait(30)
            write(file, entry)

        monkeypatch.setattr(TakeFile, "write", blocked)


@pytest.fixture
def blocked(monkeypatch: pytest.MonkeyPatch) -> Iterator[BlockedDisk]:
    disk = BlockedDisk(monkeypatch)
    yield disk
    disk.release.set()


def test_a_slow_disk_costs_whole_frames_which_the_status_and_the_file_count(
    tmp_path: Path, blocked: BlockedDisk
) -> None:
    sink = sink_to(tmp_path / "take.mcap", queue_mib=8)
    sink.start()
    for k in range(12):  # returns at once for each, though the disk takes none
        sink.add(frame(k, size=1 << 20))
    assert blocked.reached.wait(30)
    assert sink.status().dropped == 4
    blocked.release.set()
    sink.stop()
    recording = Recording(tmp_path / "take.mcap")
    entries = list(recording.entries())
    assert [entry.sequence for entry in entries if isinstance(entry, EncodedFrame)] == list(range(8))
    assert [entry for entry in entries if isinstance(entry, DroppedFrames)] == [
        DroppedFrames(0, 4, 8000, 11_000)
    ]
    assert recording.document(MANIFEST)["not_recorded"] == {"0": {"frames": 4, "times": 1}}


class SmallDisk:
    """A file on a disk that holds so many bytes, the room kept counted in."""

    def __init__(self, file: object, sink: RecordSink, capacity: int) -> None:
        self._file, self._sink, self._free = file, sink, capacity

    def write(self, data: memoryview) -> int:
        file = self._sink._recorder._file
        free = self._free + (0 if file._disk._reserve is not None else 16 << 20)
        if not free:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = int(self._file.write(data[:free]))  # type: ignore[attr-defined]
        self._free -= written
        return written

    def close(self) -> None:
        self._file.close()  # type: ignore[attr-defined]


def test_a_full_disk_ends_the_recording_with_a_sound_file_and_hurts_nobody(tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    sink = sink_to(path, keep_free_mib=0)
    sink.start()
    disk = sink._recorder._file._disk
    disk._file = SmallDisk(disk._file, sink, 10 << 20)  # type: ignore[assignment]
    for k in range(20):
        sink.add(frame(k, size=1 << 20))
    sink._thread.join(30)
    assert sink.status().ended == "the disk is full"
    sink.add(frame(99))  # forgotten, without an error
    sink.stop()
    with path.open("rb") as file:  # as any program reads it
        messages = list(make_reader(file, validate_crcs=True).iter_messages())
    assert len(messages) >= 9
    assert not Recording(path).torn


def test_a_disk_with_too_little_room_ends_the_recording_in_order(tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    sink = sink_to(path, keep_free_mib=1 << 30)
    sink.start()
    sink.add(frame(0))
    sink._thread.join(30)
    ended = sink.status().ended
    sink.stop()
    assert ended is not None
    assert "MiB of the disk are free" in ended
    assert not Recording(path).torn


def test_a_disk_that_fails_is_let_go_of(tmp_path: Path) -> None:
    """A stick that was pulled out can be unmounted, and the room kept is free again."""

    class FailingFile:
        def write(self, _: memoryview) -> int:
            raise OSError(errno.EIO, "Input/output error")

        def close(self) -> None:
            closed.set()

    closed = threading.Event()
    sink = sink_to(tmp_path / "take.mcap")
    disk = sink._recorder._file._disk
    disk._file.close()
    disk._file = FailingFile()  # type: ignore[assignment]
    sink.start()
    sink.add(frame(0, size=8 << 20))
    sink._thread.join(30)
    assert "Input/output error" in (sink.status().ended or "")
    assert closed.is_set()
    assert disk._reserve is None


def test_a_disk_that_does_not_tell_its_room_holds_up_no_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, release = threading.Event(), threading.Event()

    def hanging(_: Path) -> int:
        asked.set()
        assert release.wait(60)
        return 1 << 40

    sink = sink_to(tmp_path / "take.mcap")
    monkeypatch.setattr(recorder, "_free_bytes", hanging)
    asking = threading.Thread(target=sink.status)
    asking.start()
    try:
        assert asked.wait(30)
        giving = threading.Thread(target=sink.add, args=(frame(0),), daemon=True)
        giving.start()
        giving.join(10)
        assert not giving.is_alive()
    finally:
        release.set()
        asking.join(30)
        sink.start()
        sink.stop()


def test_a_take_that_is_being_recorded_is_not_mended(tmp_path: Path) -> None:
    """It would go on in what is kept as FILE.torn, which one deletes."""
    path = tmp_path / "take.mcap"
    sink = sink_to(path)
    sink.start()
    for k in range(5):
        sink.add(frame(k))
    with pytest.raises(RigError, match="is being recorded"):
        recover(path)
    sink.stop()
    assert recover(path) == []
    assert len(list(Recording(path).entries())) == 5
    assert list(tmp_path.iterdir()) == [path]


def test_a_take_does_not_become_a_part_of_another(tmp_path: Path) -> None:
    (tmp_path / "old.001.mcap").write_bytes(b"dear")
    with pytest.raises(ConfigurationError, match=r"old\.001\.mcap exists"):
        sink_to(tmp_path / "old.mcap")
    (tmp_path / "take.mcap").write_bytes(b"dear")
    for part in ("take.001.mcap", "take.017.mcap"):
        with pytest.raises(ConfigurationError, match=r"part of \S*take\.mcap: give another name"):
            sink_to(tmp_path / part)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["old.001.mcap", "take.mcap"]


def test_a_take_is_split_by_size_and_read_as_one(tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    sink = sink_to(path, part_gib=0.01)
    sink.start()
    for k in range(40):
        sink.add(frame(k, size=1 << 20))
    sink.stop()
    assert [part.name for part in part_paths(path)][:2] == ["take.mcap", "take.001.mcap"]
    recording = Recording(path)
    assert [entry.sequence for entry in recording.entries()] == list(range(40))  # type: ignore[union-attr]
    assert sink.status().bytes == sum(part.stat().st_size for part in part_paths(path))


def test_a_take_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    path.write_bytes(b"dear")
    with pytest.raises(ConfigurationError, match="exists"):
        sink_to(path).start()
    with pytest.raises(ConfigurationError, match="cannot be recorded to"):
        sink_to(tmp_path / "none" / "take.mcap").start()


def test_a_kill_loses_at_most_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    with subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"now\n"
        killed_ns = time.monotonic_ns()
        child.send_signal(signal.SIGKILL)
    recording = Recording(path)
    frames = [entry for entry in recording.entries() if isinstance(entry, EncodedFrame)]
    assert recording.torn == (path,)
    assert [one.sequence for one in frames] == list(range(len(frames)))
    assert killed_ns - frames[-1].timestamp_ns < 1_000_000_000
    assert [one.name for one in tmp_path.iterdir()] == ["take.mcap"]


def test_a_live_rig_records_what_came_before_it_gives_the_first_set(tmp_path: Path) -> None:
    settings = RigSettings(
        listen="127.0.0.1:0",
        insecure=True,
        expected_cameras=2,
        synchroniser=SynchroniserSettings(deadline_ms=500),
    )
    path = tmp_path / "take.mcap"
    with Rig.live(settings, record=path) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        with SmallAgent(0, (host, int(port))), SmallAgent(1, (host, int(port))):
            rig.wait_for_cameras(30)
            sets = [one for _, one in zip(range(20), rig, strict=False)]
            status = rig.status().recording
    assert status is not None
    recording = Recording(path)
    entries = list(recording.entries())
    recorded = [entry for entry in entries if isinstance(entry, RecordedSet)]
    frames = {(f.camera_id, f.timestamp_ns): f for f in entries if isinstance(f, EncodedFrame)}
    assert [one.index for one in recorded] == [one.index for one in sets]
    for one in sets:
        for given in one.frames.values():
            if given is not None:
                came = frames[given.camera_id, given.timestamp_ns]
                assert came.color is not None
                assert came.depth is not None
                assert came.color.codec_id == COLOR.id
                assert bytes(came.color.data) == COLOR.encode(BAYER)
                assert np.frombuffer(came.depth.data, np.uint16)[-1] == (RAW + given.camera_id)[-1, -1]
                assert (came.gravity, came.received_ns) == (given.gravity, given.received_ns)
    assert recording.description.camera_ids == (0, 1)
    assert json.loads(recording.attachments["settings.json"])["expected_cameras"] == 2
    assert recording.document(MANIFEST)["received"]["1"]["frames"] > 0


def test_a_running_rig_starts_and_ends_recordings_one_after_another(tmp_path: Path) -> None:
    with Rig.live(SETTINGS) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        with SmallAgent(0, (host, int(port))), SmallAgent(1, (host, int(port))):
            rig.wait_for_cameras(30)
            assert rig.stop_recording() is None
            for name in ("a.mcap", "b.mcap"):
                rig.start_recording(tmp_path / name)
                with pytest.raises(RigError, match="is being recorded"):
                    rig.start_recording(tmp_path / "c.mcap")
                given = [one for _, one in zip(range(15), rig, strict=False)]
                status = rig.stop_recording()
                assert status is not None
                assert status.frames > 0
                assert rig.status().recording is None
                assert rig.next_panorama(5.0) is not None  # and is not recorded
                with Rig.replayed(tmp_path / name, SETTINGS, ReplayOptions(speed=None)) as replayed:
                    assert same_set(list(replayed)[-1], given[-1])


def test_the_operator_reads_how_the_recording_is_and_why_it_ended() -> None:
    going = RecordingStatus(Path("takes/a.mcap"), 75.0, 1860, 3_000_000_000, 0, 0, 288_000_000_000)
    figures, troubles = summary(RigStatus((), recording=going))
    assert "recording a.mcap: 1:15, 3.00 GB, 40 MB/s, room for 2 h 00 min" in figures
    assert troubles == []
    slow = replace(going, dropped=7, ended="the disk is full")
    figures, troubles = summary(RigStatus((), recording=slow))
    assert "frames not recorded: 7" in troubles
    assert alarms(RigStatus((), recording=slow)) == ["recording takes/a.mcap ended: the disk is full"]
