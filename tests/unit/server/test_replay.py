"""Rules of replay: the sets that went out, bit for bit, at the pace that is asked for."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.frames import EncodedFrame, PanoramicFrame
from rig_protocol.recording import DESCRIPTION, HELLOS, Recording, RecordingWriter, recover
from rig_protocol.recording_format import RecordedSet
from rig_server import Rig, pace
from rig_server.config import RecordingSettings, RigSettings
from rig_server.replay import ReplayOptions
from support.takes import SETTINGS, record_take, same_images, same_set

FASTEST = ReplayOptions(speed=None)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PanoramicFrame]]:
    path = tmp_path_factory.mktemp("takes") / "take.mcap"
    return path, record_take(path)


def played(path: Path, options: ReplayOptions = FASTEST) -> list[PanoramicFrame]:
    with Rig.replayed(path, RigSettings(), options) as rig:
        return list(rig)


def all_same(given: list[PanoramicFrame], live: list[PanoramicFrame]) -> bool:
    return len(given) == len(live) and all(map(same_set, given, live))


def test_replay_gives_the_live_sets_bit_for_bit(take: tuple[Path, list[PanoramicFrame]]) -> None:
    path, live = take
    sets = played(path)
    assert all_same(sets, live)
    assert [one.index for one in sets] == [one.index for one in live]


def test_a_replayed_rig_is_whole_and_tells_its_cameras_and_counts(
    take: tuple[Path, list[PanoramicFrame]],
) -> None:
    path, live = take
    with Rig.open(path, SETTINGS) as rig:
        rig.wait_for_cameras(timeout_s=0.0)
        assert rig.source == "recording"
        assert rig.description.camera_ids == (0, 1)
        assert {i: hello.serial for i, hello in rig.hellos.items()} == {0: "S0", 1: "S1"}
        for _ in live:
            assert rig.next_panorama(5.0) is not None
        status = rig.status()
        with pytest.raises(RigError, match="no live rig"):
            rig.control(None, "led", "green")
    assert status.complete + status.partial == len(live)
    assert sum(camera.frames for camera in status.cameras) == 2 * len(live)


def test_live_speed_gives_a_set_when_it_is_due(
    take: tuple[Path, list[PanoramicFrame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sleeping advances the clock: the waits add up to the time that the take took, or a part of it."""
    path, live = take
    times = [e.taken_ns for e in Recording(path).entries() if isinstance(e, RecordedSet)]
    now_s = 0.0

    def sleep(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    monkeypatch.setattr(pace.time, "monotonic", lambda: now_s)  # type: ignore[attr-defined]
    monkeypatch.setattr(pace.time, "sleep", sleep)  # type: ignore[attr-defined]
    for speed in (1.0, 4.0):
        now_s = 0.0
        with Rig.replayed(path, RigSettings(), ReplayOptions(speed)) as rig:
            assert len(list(rig)) == len(live)
        assert now_s == pytest.approx((times[-1] - times[0]) / 1e9 / speed, rel=1e-6)
    now_s, rounds = 0.0, 3
    with Rig.replayed(path, RigSettings(), ReplayOptions(loop=True)) as rig:  # a loop keeps the pace, too
        assert len(list(islice(rig, rounds * len(live)))) == rounds * len(live)
    assert now_s >= (rounds * (times[-1] - times[0]) + (rounds - 1) * 33_000_000) / 1e9


def test_a_loop_begins_again_and_indices_and_times_go_on(take: tuple[Path, list[PanoramicFrame]]) -> None:
    path, live = take
    with Rig.replayed(path, RigSettings(), ReplayOptions(None, loop=True)) as rig:
        sets = list(islice(rig, 2 * len(live) + 3))
    assert all_same(sets[: len(live)], live)
    assert all(map(same_images, sets, [*live, *live, *live[:3]]))
    indices = [one.index for one in sets]
    assert indices == sorted(set(indices))
    for camera_id in live[0].frames:
        frames = [frame for one in sets if (frame := one.frames[camera_id]) is not None]
        times = [frame.timestamp_ns for frame in frames]
        assert times == sorted(set(times))


def test_what_is_played_can_be_recorded_and_plays_the_same(
    take: tuple[Path, list[PanoramicFrame]], tmp_path: Path
) -> None:
    """However fast it is played: the play waits for the disk. Names, times and date are the first take's."""
    path, live = take
    copy = tmp_path / "copy.mcap"
    settings = SETTINGS.model_copy(update={"recording": RecordingSettings(queue_mib=8)})
    with Rig.replayed(path, settings, FASTEST, record=copy) as rig:
        given = list(rig)
        while (status := rig.status().recording) is not None and status.waiting_bytes:
            rig.next_panorama(0.01)
        assert status is not None
        assert status.dropped == 0
    assert all_same(given, live)
    assert all_same(played(copy), live)
    first, second = Recording(path), Recording(copy)
    assert second.clock == first.clock
    assert second.document(DESCRIPTION) == first.document(DESCRIPTION)
    assert first.utc_minus_rig_time_ns is not None
    assert second.utc_minus_rig_time_ns == pytest.approx(first.utc_minus_rig_time_ns, abs=2e9)
    assert encoded(copy).items() <= encoded(path).items()


def test_a_part_of_a_take_is_cut_by_seeking_and_ending_the_recording(
    take: tuple[Path, list[PanoramicFrame]], tmp_path: Path
) -> None:
    path, live = take
    with Rig.replayed(path, SETTINGS, FASTEST) as rig:
        for _ in range(4):
            rig.next_panorama(5.0)
        rig.start_recording(tmp_path / "part.mcap")
        with pytest.raises(RigError, match="is being recorded"):
            rig.start_recording(tmp_path / "other.mcap")
        for _ in range(5):
            rig.next_panorama(5.0)
        status = rig.stop_recording()
        assert status is not None
        assert status.frames > 0
    assert all_same(played(tmp_path / "part.mcap"), live[4:9])


def test_seek_leaves_out_what_came_before_and_nothing_of_a_set(
    take: tuple[Path, list[PanoramicFrame]],
) -> None:
    path, live = take
    recording = Recording(path)
    times = [e.taken_ns for e in recording.entries() if isinstance(e, RecordedSet)]
    seek_s = (times[8] - recording.start_ns) / 1e9
    assert all_same(played(path, ReplayOptions(None, seek_s=seek_s - 1e-6)), live[8:])
    with pytest.raises(ConfigurationError, match="lasts"):
        Rig.replayed(path, RigSettings(), ReplayOptions(seek_s=1e6))
    with pytest.raises(ConfigurationError, match="lasts"):
        Rig.replayed(path, RigSettings(), ReplayOptions(seek_s=float("nan")))


def encoded(path: Path) -> dict[tuple[int, int], bytes | None]:
    """Depth as it was sent, by camera and time."""
    frames = [entry for entry in Recording(path).entries() if isinstance(entry, EncodedFrame)]
    return {(f.camera_id, f.timestamp_ns): f.depth and bytes(f.depth.data) for f in frames}


def rewrite(
    path: Path, source: Path, keep: type | tuple[type, ...], finish: bool = True, created: str = ""
) -> None:
    """A copy that holds the entries of some kinds only, flushed every now and then."""
    recording = Recording(source)
    with path.open("wb") as output:
        writer = RecordingWriter(output, created, 1 if created else 0)
        for name in (DESCRIPTION, HELLOS):
            writer.attach(name, recording.document(name), 0)
        for number, entry in enumerate(recording.entries()):
            if isinstance(entry, keep):
                writer.write(entry)
            if number % 10 == 0:
                writer.flush()
        if finish:
            writer.finish()


def test_a_take_of_a_date_out_of_reason_can_be_recorded_again(
    take: tuple[Path, list[PanoramicFrame]], tmp_path: Path
) -> None:
    path, live = take
    rewrite(tmp_path / "late.mcap", path, (EncodedFrame, RecordedSet), created="9999-12-31T23:59:59+00:00")
    with Rig.replayed(tmp_path / "late.mcap", SETTINGS, FASTEST, record=tmp_path / "copy.mcap") as rig:
        assert len(list(rig)) == len(live)
    assert Recording(tmp_path / "copy.mcap").utc_minus_rig_time_ns is None
    assert all_same(played(tmp_path / "copy.mcap"), live)


def test_a_take_without_sets_is_grouped_anew(take: tuple[Path, list[PanoramicFrame]], tmp_path: Path) -> None:
    path, live = take
    rewrite(tmp_path / "frames.mcap", path, EncodedFrame)
    sets = played(tmp_path / "frames.mcap")
    complete = [one for one in sets if one.complete]
    assert len(complete) >= len(live) - 2
    stamps = [f.timestamp_ns for one in sets for f in one.frames.values() if f is not None]
    assert len(set(stamps)) == len(stamps)


def test_a_torn_take_plays_as_far_as_it_goes_and_the_same_after_recovery(
    take: tuple[Path, list[PanoramicFrame]], tmp_path: Path
) -> None:
    path, live = take
    torn = tmp_path / "torn.mcap"
    rewrite(tmp_path / "whole.mcap", path, (EncodedFrame, RecordedSet), finish=False)
    data = (tmp_path / "whole.mcap").read_bytes()
    torn.write_bytes(data[: len(data) * 9 // 10])  # the sets come last
    before = played(torn)
    assert 0 < len(before) < len(live)
    assert all_same(before, live[: len(before)])
    recover(torn)
    assert all_same(played(torn), before)


def test_a_take_that_tells_no_cameras_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    with path.open("wb") as output:
        RecordingWriter(output, "", 0).finish()
    with pytest.raises(DataError, match="before a camera came"):
        Rig.open(path, RigSettings())


def test_a_frame_that_does_not_decode_is_missing_from_its_set(
    take: tuple[Path, list[PanoramicFrame]], tmp_path: Path
) -> None:
    path, live = take
    recording = Recording(path)
    with (tmp_path / "bad.mcap").open("wb") as output:
        writer = RecordingWriter(output, "", 0)
        for name in (DESCRIPTION, HELLOS):
            writer.attach(name, recording.document(name), 0)
        for entry in recording.entries():
            if isinstance(entry, EncodedFrame) and entry.camera_id == 1 and entry.color is not None:
                entry = replace(entry, color=replace(entry.color, data=b"no image"))
            writer.write(entry)
        writer.finish()
    sets = played(tmp_path / "bad.mcap")
    assert len(sets) == len(live)
    assert all(one.missing == (1,) for one in sets)


def test_a_frame_that_was_not_recorded_is_missing_from_its_set(
    take: tuple[Path, list[PanoramicFrame]], tmp_path: Path
) -> None:
    path, live = take
    recording = Recording(path)
    with (tmp_path / "lossy.mcap").open("wb") as output:
        writer = RecordingWriter(output, "", 0)
        for name in (DESCRIPTION, HELLOS):
            writer.attach(name, recording.document(name), 0)
        for entry in recording.entries():
            if not (isinstance(entry, EncodedFrame) and entry.camera_id == 0):
                writer.write(entry)
        writer.finish()
    sets = played(tmp_path / "lossy.mcap")
    assert [one.index for one in sets] == [one.index for one in live]
    assert all(one.missing == (0,) for one in sets)
