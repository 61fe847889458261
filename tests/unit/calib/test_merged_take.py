"""Rules of merging: nothing lost, nothing doubled, one clock, one rig, and never over what is there."""

import json
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig_calib.merged_take import MERGE, merge_takes
from rig_calib.recorded_panoramas import recorded_panoramas
from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec_by_name
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import told_hellos
from rig_protocol.recording import DESCRIPTION, HELLOS, MANIFEST, Recording, RecordingWriter, part_path
from rig_protocol.recording_format import (
    AGENT,
    UTC,
    ClockReading,
    ClockTie,
    DroppedFrames,
    Entry,
    RecordedSet,
)
from rig_protocol.rig_folder import CameraEntry, RigDescription
from rig_server import Rig
from rig_server.config import RigSettings
from rig_server.replay import ReplayOptions

RIG = "rig:0123"
PERIOD_NS, SECOND_NS = 33_000_000, 1_000_000_000
OFFSETS_NS = {0: 5_000_000_000, 1: -700_000_000, 2: 88_000_000_000}
"""Rig time less agent time."""
COLOR, DEPTH = codec_by_name("bayer-uncompressed"), codec_by_name("disparity-uncompressed")
COUNT = 40


def frame(camera_id: int, k: int) -> EncodedFrame:
    """In the agent's time; frame k was exposed 200 s and k periods from zero in rig time, 3 ms a camera."""
    image = np.full((4, 6), 50 * camera_id + k, np.uint8)
    payloads = (
        Payload(COLOR.id, COLOR.encode(image)),
        Payload(DEPTH.id, DEPTH.encode(image.astype(np.uint16))),
    )
    rig_ns = 200 * SECOND_NS + k * PERIOD_NS + 3_000_000 * camera_id
    return EncodedFrame(camera_id, k, rig_ns - OFFSETS_NS[camera_id], 1_000, *payloads)


def readings(camera_id: int, clock: str = RIG, more_ns: int = 0) -> list[ClockReading]:
    """At the beginning and the end."""
    tie = ClockTie(clock, OFFSETS_NS[camera_id] + more_ns, 20_000)
    times_ns = (frame(camera_id, 0).timestamp_ns, frame(camera_id, COUNT).timestamp_ns)
    return [ClockReading(time_ns, (tie,)) for time_ns in times_ns]


def write(
    path: Path,
    camera_id: int,
    entries: Iterable[Entry],
    clock: str | None = AGENT,
    serial: str | None = None,
    finish: bool = True,
    begun: tuple[str, int] = ("", 0),
) -> Path:
    name = f"cam{camera_id:02d}"
    hello = Hello(name, camera_id, serial, None, CameraModel(), (COLOR.id,), (DEPTH.id,), 30.0, "test")
    with path.open("wb") as output:
        writer = RecordingWriter(output, *begun, clock)
        cameras = (CameraEntry(camera_id, name, CameraModel()),)
        writer.attach(DESCRIPTION, RigDescription(cameras).to_dict(), 0)
        writer.attach(HELLOS, told_hellos({camera_id: hello}), 0)
        for entry in entries:
            writer.write(entry)
        writer.flush()
        if finish:
            writer.finish({str(camera_id): {"frames": COUNT, "lost": camera_id}})
    return path


def taken(camera_id: int, ks: Iterable[int] = range(COUNT), clock: str = RIG) -> list[Entry]:
    return [*(frame(camera_id, k) for k in ks), *readings(camera_id, clock)]


@pytest.fixture
def takes(tmp_path: Path) -> list[Path]:
    return [write(tmp_path / f"pi{i}.mcap", i, taken(i)) for i in range(3)]


def frames_of(path: Path) -> list[EncodedFrame]:
    return [entry for entry in Recording(path).entries() if isinstance(entry, EncodedFrame)]


def test_every_frame_is_there_once_in_the_order_of_rig_time(takes: list[Path], tmp_path: Path) -> None:
    merged = merge_takes(takes, tmp_path / "rig.mcap")
    frames = frames_of(tmp_path / "rig.mcap")
    assert (merged.clock, merged.frames, merged.sets) == (RIG, 3 * COUNT, COUNT)
    assert [(one.sequence, one.camera_id) for one in frames] == [
        (k, i) for k in range(COUNT) for i in range(3)
    ]
    for one in frames:
        origin = frame(one.camera_id, one.sequence)
        assert (one.color, one.depth) == (origin.color, origin.depth)
        assert one.timestamp_ns == origin.timestamp_ns + OFFSETS_NS[one.camera_id]
        assert 20_000 < one.uncertainty_ns < 20_100
    recording = Recording(tmp_path / "rig.mcap")
    assert recording.clock == RIG
    assert recording.description.camera_ids == (0, 1, 2)
    assert [part["frames"] for part in recording.document(MERGE)["takes"]] == [COUNT] * 3


def test_everything_else_plays_what_was_merged(takes: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "rig.mcap"
    merge_takes(takes, out)
    panoramas = list(recorded_panoramas(out, COUNT))
    with Rig.replayed(out, RigSettings(), ReplayOptions(speed=None)) as rig:
        replayed = list(rig)
    assert len(panoramas) == len(replayed) == COUNT
    for k, (one, other) in enumerate(zip(panoramas, replayed, strict=True)):
        assert one.timestamp_ns == other.timestamp_ns == 200 * SECOND_NS + k * PERIOD_NS + 3_000_000
        for i in range(3):
            mine, theirs = one.frames[i], other.frames[i]
            assert mine is not None
            assert theirs is not None
            assert np.array_equal(mine.raw, np.full((4, 6), 50 * i + k))
            assert np.array_equal(mine.bayer, theirs.bayer)


def test_a_merged_take_tells_the_date_of_its_frames(takes: list[Path], tmp_path: Path) -> None:
    utc_ns = 1_700_000_000 * SECOND_NS
    begun_ns = frame(1, 0).timestamp_ns
    dated = write(tmp_path / "dated.mcap", 1, taken(1), begun=("2023-11-14T22:13:20+00:00", begun_ns))
    merge_takes([takes[0], dated], tmp_path / "rig.mcap")
    known = Recording(tmp_path / "rig.mcap").utc_minus_rig_time_ns
    assert known is not None
    assert abs(known - (utc_ns - begun_ns - OFFSETS_NS[1])) < SECOND_NS
    merge_takes(takes[:2], tmp_path / "dateless.mcap")
    assert Recording(tmp_path / "dateless.mcap").utc_minus_rig_time_ns is None


def test_one_agents_take_is_a_rig_of_one_camera(takes: list[Path]) -> None:
    assert [sorted(one.frames) for one in recorded_panoramas(takes[1], 3)] == [[1]] * 3


def test_sets_are_no_wider_than_is_asked_for(takes: list[Path], tmp_path: Path) -> None:
    merge_takes(takes, tmp_path / "rig.mcap", max_spread_ms=4.0)
    sets = [entry for entry in Recording(tmp_path / "rig.mcap").entries() if isinstance(entry, RecordedSet)]
    for one in sets:
        times_ns = [time_ns for time_ns in one.timestamps_ns.values() if time_ns is not None]
        assert max(times_ns) - min(times_ns) <= 4_000_000
    assert len(sets) > COUNT


def test_without_a_server_wall_clocks_tie_the_takes(tmp_path: Path) -> None:
    utc_ns = 1_700_000_000 * SECOND_NS
    paths = [
        write(tmp_path / f"{i}.mcap", i, [*(frame(i, k) for k in range(COUNT)), *readings(i, UTC, utc_ns)])
        for i in range(2)
    ]
    merged = merge_takes(paths, tmp_path / "rig.mcap")
    assert (merged.clock, merged.sets) == (UTC, COUNT)
    assert frames_of(tmp_path / "rig.mcap")[0].timestamp_ns == utc_ns + 200 * SECOND_NS


def test_a_servers_take_goes_with_those_of_agents_that_hear_it(takes: list[Path], tmp_path: Path) -> None:
    served = [
        replace(
            one,
            timestamp_ns=one.timestamp_ns + OFFSETS_NS[2],
            received_ns=one.timestamp_ns + OFFSETS_NS[2] + 9,
        )
        for one in (frame(2, k) for k in range(COUNT))
    ]
    stale = RecordedSet(0, served[5].timestamp_ns, {2: served[5].timestamp_ns})
    server = write(tmp_path / "server.mcap", 2, [*served, stale], clock=RIG)
    merged = merge_takes([*takes[:2], server], tmp_path / "rig.mcap")
    assert (merged.frames, merged.sets) == (3 * COUNT, COUNT)
    assert [one for one in frames_of(tmp_path / "rig.mcap") if one.camera_id == 2] == served


def test_takes_that_no_clock_ties_are_refused(takes: list[Path], tmp_path: Path) -> None:
    alone = write(tmp_path / "alone.mcap", 2, [frame(2, k) for k in range(3)])
    with pytest.raises(
        ConfigurationError, match=r"no clock is known to all takes .*alone.mcap knows no other clock"
    ):
        merge_takes([*takes[:2], alone], tmp_path / "rig.mcap")
    assert not (tmp_path / "rig.mcap").exists()


def test_two_cameras_in_one_slot_are_refused_with_both_files(tmp_path: Path) -> None:
    one = write(tmp_path / "one.mcap", 0, taken(0, range(5)), serial="K1")
    other = write(tmp_path / "other.mcap", 0, taken(0, range(9, 12)), serial="K2")
    with pytest.raises(
        ConfigurationError, match=r"slot 0 is the camera K1 in .*one.mcap and the camera K2 in .*other"
    ):
        merge_takes([one, other], tmp_path / "rig.mcap")


def test_one_camera_may_be_in_two_takes_one_after_the_other_but_not_at_a_time(tmp_path: Path) -> None:
    first = write(tmp_path / "first.mcap", 0, taken(0, range(20)), serial="K1")
    second = write(tmp_path / "second.mcap", 0, taken(0, range(20, 40)), serial="K1")
    assert merge_takes([second, first], tmp_path / "rig.mcap").frames == 40
    assert [one.sequence for one in frames_of(tmp_path / "rig.mcap")] == list(range(40))
    with pytest.raises(
        ConfigurationError, match=r"camera 0 is in .*first.mcap and .*copy.mcap at the same time"
    ):
        merge_takes([first, Path(shutil.copy(first, tmp_path / "copy.mcap"))], tmp_path / "again.mcap")


def test_the_parts_of_a_take_may_be_named_too(takes: list[Path], tmp_path: Path) -> None:
    part = write(part_path(takes[0], 1), 0, taken(0, range(COUNT, COUNT + 5)))
    assert merge_takes([*takes, part], tmp_path / "rig.mcap").frames == 3 * COUNT + 5


def test_drops_and_losses_of_all_takes_are_summed_up(tmp_path: Path) -> None:
    last_ns = frame(1, 7).timestamp_ns
    dropped = DroppedFrames(1, 3, frame(1, 5).timestamp_ns, last_ns)
    paths = [
        write(tmp_path / "a.mcap", 0, taken(0)),
        write(
            tmp_path / "b.mcap", 1, [*taken(1, range(5)), dropped, *(frame(1, k) for k in range(8, COUNT))]
        ),
    ]
    assert merge_takes(paths, tmp_path / "rig.mcap").not_recorded == 3
    manifest = Recording(tmp_path / "rig.mcap").document(MANIFEST)
    assert manifest["not_recorded"] == {"1": {"frames": 3, "times": 1}}
    assert manifest["received"] == {"0": {"frames": COUNT, "lost": 0}, "1": {"frames": COUNT, "lost": 1}}
    (told,) = [
        entry for entry in Recording(tmp_path / "rig.mcap").entries() if isinstance(entry, DroppedFrames)
    ]
    assert told.last_ns == last_ns + OFFSETS_NS[1]


def test_a_torn_take_is_merged_as_far_as_it_goes(takes: list[Path], tmp_path: Path) -> None:
    torn = write(tmp_path / "torn.mcap", 2, taken(2), finish=False)
    merged = merge_takes([*takes[:2], torn], tmp_path / "rig.mcap")
    assert [part.torn for part in merged.parts] == [False, False, True]
    assert merged.frames == 3 * COUNT


def test_nothing_is_overwritten_and_a_failure_leaves_nothing(takes: list[Path], tmp_path: Path) -> None:
    (tmp_path / "rig.mcap").write_bytes(b"dear")
    with pytest.raises(ConfigurationError, match="never overwritten"):
        merge_takes(takes, tmp_path / "rig.mcap")
    assert (tmp_path / "rig.mcap").read_bytes() == b"dear"
    wild = [frame(0, 0), ClockReading(0, (ClockTie(RIG, -(2**62), 0),))]
    with pytest.raises(DataError, match=r"wild.mcap: the clock of the take is out of reason"):
        merge_takes([write(tmp_path / "wild.mcap", 0, wild), takes[1]], tmp_path / "new.mcap")
    assert not list(tmp_path.glob("new*"))


def test_the_command_says_on_which_clock_and_how_well(takes: list[Path], tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from rig_calib.cli import app

    words = ["merge", *map(str, takes), "--out", str(tmp_path / "rig.mcap")]
    table = CliRunner().invoke(app, words)
    assert table.exit_code == 0
    assert f"120 frames in 40 sets, on the clock {RIG}" in table.output
    words[-1] = str(tmp_path / "json.mcap")
    told = json.loads(CliRunner().invoke(app, [*words, "--json"]).output)
    assert [part["typical_uncertainty_ns"] for part in told["takes"]] == [20_000] * 3
