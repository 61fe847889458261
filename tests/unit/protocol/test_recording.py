"""A take on disk: everything that was recorded comes back, whatever happened to the file."""

import io
import struct
from pathlib import Path

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.gravity import Gravity
from rig_protocol.mcap_scan import MAGIC, MAX_RECORD_BYTES, scan
from rig_protocol.recording import (
    DESCRIPTION,
    MANIFEST,
    Recording,
    RecordingWriter,
    part_path,
    recover,
)
from rig_protocol.recording_format import (
    ClockReading,
    ClockTie,
    DroppedFrames,
    Entry,
    EntryParser,
    RecordedSet,
)
from rig_protocol.rig_folder import CameraEntry, RigDescription

RIG = RigDescription((CameraEntry(0, "cam00", CameraModel()), CameraEntry(11, "front", CameraModel())))


def frame(camera_id: int, k: int, **changes: object) -> EncodedFrame:
    values: dict[str, object] = {
        "camera_id": camera_id,
        "sequence": k,
        "timestamp_ns": 1_000_000_000 + k * 33_000_000 + camera_id,
        "uncertainty_ns": 12_345,
        "color": Payload(1, bytes([k % 251]) * 3000),
        "depth": Payload(2, bytes([camera_id]) * 2000),
        "received_ns": 1_020_000_000 + k * 33_000_000 + camera_id,
    }
    return EncodedFrame(**values | changes)  # type: ignore[arg-type]


def entries(count: int = 30) -> list[Entry]:
    taken: list[Entry] = []
    for k in range(count):
        pair = [frame(0, k), frame(11, k, damaged=k % 7 == 0, gravity=Gravity((0.0, 0.6, 0.8), 1.25))]
        taken += pair
        stamps: dict[int, int | None] = {0: pair[0].timestamp_ns, 11: pair[1].timestamp_ns}
        taken.append(RecordedSet(k, pair[1].received_ns or 0, stamps))
    return taken


def write(path: Path, taken: list[Entry], finish: bool = True, flush_every: int = 9) -> None:
    with path.open("wb") as output:
        writer = RecordingWriter(output, "2026-01-02T03:04:05+00:00", 5)
        writer.attach(DESCRIPTION, RIG.to_dict(), 5)
        for number, entry in enumerate(taken, 1):
            writer.write(entry)
            if number % flush_every == 0:
                writer.flush()
        if finish:
            writer.finish()


def test_everything_comes_back_as_it_was(tmp_path: Path) -> None:
    taken = [
        *entries(),
        frame(0, 40, depth=None),
        frame(0, 41, color=None, depth_frame="color"),
        frame(0, 42, color=None, depth=None),
        frame(0, 43, received_ns=None, sequence=2**64 - 1),
        RecordedSet(30, 9_000_000_000, {0: None, 11: -5}),
        DroppedFrames(11, 3, -7, 9_000_000_001),
        ClockReading(9_000_000_002, (ClockTie("rig:0123", -5, 0), ClockTie("utc", 2**62, 2**62))),
        ClockReading(9_000_000_003, ()),
    ]
    write(tmp_path / "take.mcap", taken)
    recording = Recording(tmp_path / "take.mcap")
    assert list(recording.entries()) == taken
    assert recording.description.to_dict() == RIG.to_dict()
    assert recording.has_sets
    assert not recording.torn
    assert recording.document(MANIFEST)["not_recorded"] == {"11": {"frames": 3, "times": 1}}


def test_the_mcap_library_reads_it_with_the_channels_of_the_contract(tmp_path: Path) -> None:
    write(tmp_path / "take.mcap", entries())
    with (tmp_path / "take.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        topics = {channel.topic for _, channel, _ in reader.iter_messages()}
        names = {attachment.name for attachment in reader.iter_attachments()}
    assert topics == {"/cam00/color", "/cam00/depth", "/cam11/color", "/cam11/depth", "/sets"}
    assert {DESCRIPTION, MANIFEST} <= names


def test_what_was_flushed_survives_a_tear_at_any_byte(tmp_path: Path) -> None:
    taken, whole = entries(20), tmp_path / "whole.mcap"
    write(whole, taken, flush_every=15)
    data, torn = whole.read_bytes(), tmp_path / "torn.mcap"
    for size in range(len(data) - 1, 600, -3371):
        torn.write_bytes(data[:size])
        recording = Recording(torn)
        read = list(recording.entries())
        assert recording.torn == (torn,)
        assert read == taken[: len(read)]
    assert not read  # the tears went down to before the first flush


def test_recover_makes_a_torn_file_sound_and_keeps_the_original(tmp_path: Path) -> None:
    path, taken = tmp_path / "take.mcap", entries()
    write(path, taken, finish=False)
    torn = path.read_bytes()[:-1000]
    path.write_bytes(torn)
    before = list(Recording(path).entries())
    assert recover(path) == [path]
    recording = Recording(path)
    assert not recording.torn
    assert list(recording.entries()) == before
    assert len(before) >= len(taken) - 10
    assert recording.description.to_dict() == RIG.to_dict()
    assert (tmp_path / "take.mcap.torn").read_bytes() == torn
    assert recover(path) == []


def test_a_damaged_chunk_is_refused_and_recover_leaves_it_out(tmp_path: Path) -> None:
    path, taken = tmp_path / "take.mcap", entries()
    write(path, taken)
    data = bytearray(path.read_bytes())
    place = scan(path).chunks[5]
    data[place.offset + place.length // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match="rig-server recover"):
        list(Recording(path).entries())
    recover(path)
    kept = list(Recording(path).entries())
    assert len(taken) - 12 <= len(kept) < len(taken)
    assert [entry for entry in taken if entry in kept] == kept


@pytest.mark.parametrize(
    "ties",
    [
        None,
        [["utc", 1]],
        ["utc"],
        [["", 1, 2]],
        [["x" * 33, 1, 2]],
        [["utc", 2**63, 2]],
        [["utc", 1, -2]],
        [["utc", 1, 2]] * 9,
    ],
    ids=str,
)
def test_a_malformed_clock_is_refused_in_words(ties: object) -> None:
    with pytest.raises(DataError, match="a message of /clock breaks the format"):
        EntryParser().parse("/clock", msgpack.packb({"time_ns": 5, "ties": ties}))


def test_parts_are_read_as_one_take(tmp_path: Path) -> None:
    taken, path = entries(), tmp_path / "take.mcap"
    write(path, taken[:45])
    write(part_path(path, 1), taken[45:])
    assert part_path(path, 1).name == "take.001.mcap"
    recording = Recording(path)
    assert list(recording.entries()) == taken
    assert recording.start_ns < recording.end_ns == 1_020_000_000 + 29 * 33_000_000 + 11


def test_reading_begins_where_it_is_asked_to(tmp_path: Path) -> None:
    taken, path = entries(), tmp_path / "take.mcap"
    write(path, taken)
    from_ns = 1_020_000_000 + 20 * 33_000_000
    assert list(Recording(path).entries(from_ns)) == taken[60:]


def test_a_take_never_ends_before_it_begins(tmp_path: Path) -> None:
    """Players divide by its length. Found by fuzzing: a chunk's header said the opposite."""
    path, taken = tmp_path / "take.mcap", entries(3)
    write(path, taken)
    data, place = bytearray(path.read_bytes()), scan(path).chunks[0]
    data[place.offset : place.offset + 16] = struct.pack("<QQ", place.end_ns, place.start_ns)
    path.write_bytes(data)
    assert Recording(path).start_ns <= Recording(path).end_ns
    assert list(Recording(path).entries()) == taken


@pytest.mark.parametrize("content", [b"", b"PNG", MAGIC[:5]])
def test_another_file_is_refused_in_words(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "take.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match="no MCAP file"):
        Recording(path)


def test_an_absent_file_is_a_wrong_setting(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        Recording(tmp_path / "take.mcap")


def test_another_programs_mcap_is_refused_in_words(tmp_path: Path) -> None:
    from mcap.writer import Writer

    output = io.BytesIO()
    writer = Writer(output)
    writer.start()
    writer.finish()
    (tmp_path / "ros.mcap").write_bytes(output.getvalue())
    with pytest.raises(DataError, match="no recording of a rig"):
        Recording(tmp_path / "ros.mcap")


def test_a_chunk_that_would_unpack_to_gigabytes_is_refused(tmp_path: Path) -> None:
    import zstandard

    path = tmp_path / "take.mcap"
    write(path, [], finish=False)
    packed = zstandard.ZstdCompressor().compress(bytes(MAX_RECORD_BYTES + 1))
    body = struct.pack("<QQQII4sQ", 0, 1, 99, 0, 4, b"zstd", len(packed)) + packed
    path.write_bytes(path.read_bytes() + struct.pack("<BQ", 6, len(body)) + body)
    with pytest.raises(DataError, match="unpacks to more than"):
        list(Recording(path).entries())


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.lists(st.tuples(st.integers(8, 20_000), st.integers(0, 255)), min_size=1, max_size=8))
def test_altered_bytes_give_an_error_in_words_or_what_was_written(
    tmp_path: Path, changes: list[tuple[int, int]]
) -> None:
    """Never a traceback, never an altered image."""
    path, taken = tmp_path / "take.mcap", entries(4)
    write(path, taken, flush_every=3)
    data = bytearray(path.read_bytes())
    for place, value in changes:
        data[place % len(data)] = value
    path.write_bytes(data)
    try:
        read = list(Recording(path).entries())
    except DataError:
        return
    assert all(entry in taken for entry in read)
