"""A long capture is looked through without its images, and read from any place on."""

import logging
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from rig_calib.offline.capture import open_capture
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import PanoramicFrame, Payload, RgbdFrame
from rig_protocol.mcap_scan import ChunkPlace, chunk_messages, scan
from rig_protocol.recording import CALIBRATION, HELLOS, Recording
from rig_protocol.recording_format import RecordedSet
from rig_protocol.rig_folder import write_rig_folder
from support.small_take import COLOR, RIG, encoded, entries, hello_documents, write_take

SETS = 20


def pixels(one: PanoramicFrame) -> dict[int, int | None]:
    """One pixel of every camera's disparity."""
    return {
        i: None if frame is None or frame.raw is None else int(frame.raw[0, 0])
        for i, frame in one.frames.items()
    }


@pytest.fixture
def chunks_read(monkeypatch: pytest.MonkeyPatch) -> list[ChunkPlace]:
    """The chunks that are read whole from now on."""
    read: list[ChunkPlace] = []

    def noted(file: object, place: ChunkPlace, *more: object) -> object:
        read.append(place)
        return chunk_messages(file, place, *more)  # type: ignore[arg-type]

    monkeypatch.setattr("rig_protocol.recording.chunk_messages", noted)
    monkeypatch.setattr("rig_protocol.mcap_scan.chunk_messages", noted)
    return read


def test_a_take_is_opened_without_its_images(tmp_path: Path, chunks_read: list[ChunkPlace]) -> None:
    capture = open_capture(write_take(tmp_path / "take.mcap", entries(SETS)))
    assert [mark.index for mark in capture.marks] == list(range(SETS))
    assert chunks_read == []


def test_only_the_chunks_of_the_frames_asked_for_are_read(
    tmp_path: Path, chunks_read: list[ChunkPlace]
) -> None:
    path = write_take(tmp_path / "take.mcap", entries(SETS))
    chunks = scan(path).chunks
    read = list(open_capture(path).read(range(10, 13)))
    assert [one.index for one in read] == [10, 11, 12]
    assert [pixels(one) for one in read] == [{0: k, 1: 10 + k} for k in (10, 11, 12)]
    # A set of ours is a chunk; the one before is looked at, as clocks may disagree by as much.
    assert chunks_read == chunks[9:13]


def test_any_place_gives_what_reading_all_gives(tmp_path: Path) -> None:
    taken = [entry for entry in entries(SETS) if entry != encoded(1, 7)]
    capture = open_capture(write_take(tmp_path / "take.mcap", taken))
    whole = [pixels(one) for one in capture.read(range(SETS))]
    assert whole[7] == {0: 7, 1: None}
    assert [pixels(one) for k in range(SETS) for one in capture.read(range(k, k + 1))] == whole
    assert [pixels(one) for one in capture.read(range(1, SETS, 6))] == whole[1::6]


def test_frames_that_came_long_before_their_set_are_found(tmp_path: Path) -> None:
    """As for a camera of another rate, or where the rig waited for a late one."""
    late = replace(
        RecordedSet(3, 16_000_000_000, {}),
        timestamps_ns={0: encoded(0, 3).timestamp_ns, 1: encoded(1, 3).timestamp_ns},
    )
    taken = [entry for entry in entries(SETS) if not isinstance(entry, RecordedSet)]
    capture = open_capture(write_take(tmp_path / "take.mcap", [*taken, late]))
    assert [pixels(one) for one in capture.read(range(1))] == [{0: 3, 1: 13}]


def test_another_process_reads_the_capture_it_is_sent(tmp_path: Path) -> None:
    capture = open_capture(write_take(tmp_path / "take.mcap", entries(SETS)))
    sent = pickle.loads(pickle.dumps(capture))  # noqa: S301  # our own
    assert [pixels(one) for one in sent.read(range(4, 6))] == [{0: 4, 1: 14}, {0: 5, 1: 15}]


@pytest.mark.parametrize("torn_off", [0, 3000, 30_000])
def test_a_torn_take_is_read_as_far_as_it_goes(
    tmp_path: Path, chunks_read: list[ChunkPlace], torn_off: int
) -> None:
    path = write_take(tmp_path / "take.mcap", entries(SETS), finish=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size - torn_off])
    capture = open_capture(path)
    assert SETS - 5 <= len(capture.marks) <= SETS
    # The first chunk declares the channels; the last one's indexes may be torn.
    assert len(chunks_read) <= 2
    assert [pixels(one) for one in capture.read(range(9, 11))] == [{0: 9, 1: 19}, {0: 10, 1: 20}]
    assert len(chunks_read) <= 2 + 3


def test_a_frame_that_does_not_decode_is_missing_from_its_set(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    taken = entries(3)
    taken[1] = replace(encoded(1, 0), color=Payload(COLOR.id, b"no image"))
    capture = open_capture(write_take(tmp_path / "take.mcap", taken))
    with caplog.at_level(logging.WARNING):
        assert [pixels(one)[1] for one in capture.read(range(3))] == [None, 11, 12]
    assert "camera 1, frame 0 is left out" in caplog.text


def test_a_damaged_chunk_is_told_with_file_and_place(tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.mcap", entries(SETS))
    place = scan(path).chunks[10]
    data = bytearray(path.read_bytes())
    data[place.offset + place.length // 2] ^= 1
    path.write_bytes(data)
    capture = open_capture(path)
    assert len(list(capture.read(range(8)))) == 8
    with pytest.raises(DataError, match=rf"take.mcap, at byte {place.offset}: .*rig-server recover"):
        list(capture.read(range(8, 16)))


def test_a_take_without_sets_is_grouped_once_and_read_from_any_place(
    tmp_path: Path, chunks_read: list[ChunkPlace]
) -> None:
    """As an agent records it."""
    taken = [entry for entry in entries(SETS) if not isinstance(entry, RecordedSet)]
    path = write_take(tmp_path / "take.mcap", taken, flush_every=2, **{HELLOS: hello_documents()})
    capture = pickle.loads(pickle.dumps(open_capture(path)))  # noqa: S301  # our own
    whole = [pixels(one) for one in capture.read(range(len(capture.marks)))]
    assert whole == [{0: k, 1: 10 + k} for k in range(SETS)]
    chunks_read.clear()
    assert [pixels(one) for one in capture.read(range(10, 12))] == whole[10:12]
    assert len(chunks_read) < 6
    assert [pixels(one) for k in range(SETS) for one in capture.read(range(k, k + 1))] == whole


def test_a_calibration_that_cannot_be_read_is_told_with_its_file(tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.mcap", entries(2), **{CALIBRATION: {"schema": 99}})
    with pytest.raises(DataError, match=r"take.mcap: calibration.json: not a calibration of schema 1"):
        open_capture(path)


def test_a_rig_folder_is_read_from_any_place_on(tmp_path: Path) -> None:
    frames = [
        RgbdFrame(i, k, 0, color=np.zeros((4, 6, 3), np.uint8), raw=np.full((4, 6), 10 * i + k, np.uint16))
        for k in range(5)
        for i in (0, 1)
        if (i, k) != (1, 3)
    ]
    write_rig_folder(tmp_path / "rig", RIG, frames)
    capture = open_capture(tmp_path / "rig")
    assert [mark.index for mark in capture.marks] == [0, 1, 2, 3, 4]
    assert [pixels(one) for one in capture.read(range(2, 4))] == [{0: 2, 1: 12}, {0: 3, 1: None}]


def test_a_folder_without_frames_is_refused_in_words(tmp_path: Path) -> None:
    write_rig_folder(tmp_path / "rig", RIG, [])
    for camera in RIG.cameras:
        (tmp_path / "rig" / camera.name).mkdir()
    with pytest.raises(ConfigurationError, match="no panoramic frames"):
        open_capture(tmp_path / "rig")


def test_altered_bytes_never_end_in_a_traceback(tmp_path: Path) -> None:
    """Marks may be wrong where check sums are not looked at; reading them is an error in words, or right."""
    path = write_take(tmp_path / "take.mcap", entries(4))
    sound, generator = path.read_bytes(), np.random.default_rng(1)
    known = {(pixels(one)[0], pixels(one)[1]) for one in open_capture(path).read(range(4))}
    known |= {(k, None) for k, _ in known} | {(None, k) for _, k in known}
    for _ in range(150):
        data = bytearray(sound)
        for place in generator.integers(8, len(data), 4):
            data[place] = generator.integers(256)
        path.write_bytes(data)
        try:
            capture = open_capture(path)
            read = list(capture.read(range(len(capture.marks))))
        except (DataError, ConfigurationError):
            continue
        assert {(pixels(one)[0], pixels(one)[1]) for one in read} <= known


def test_sets_are_found_where_the_message_indexes_are_wrong(
    tmp_path: Path, chunks_read: list[ChunkPlace]
) -> None:
    """An index that does not fit is not believed: the chunk is read."""
    path = write_take(tmp_path / "take.mcap", entries(3))
    data, sound = bytearray(path.read_bytes()), list(Recording(path).sets())
    for place in scan(path).chunks:
        at = place.offset + place.length
        while data[at] == 7:  # a message index: channel, length, then time and offset of its one message
            data[at + 9 + 2 + 4 + 8] ^= 0x55
            at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    path.write_bytes(data)
    assert chunks_read == []
    assert list(Recording(path).sets()) == sound
    assert chunks_read == scan(path).chunks


def test_a_take_that_was_rewritten_compressed_is_read(tmp_path: Path) -> None:
    """As `mcap compress` does it: chunks that hold sets are unpacked, the others stay untouched."""
    path = write_take(tmp_path / "take.mcap", entries(3))
    sound = list(Recording(path).sets())
    packed = tmp_path / "packed.mcap"
    with path.open("rb") as file, packed.open("wb") as output:
        reader, writer = make_reader(file), Writer(output, chunk_size=2000)
        writer.start(profile="kinect-rig")
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        channels: dict[int, int] = {}
        for _, channel, message in reader.iter_messages():
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, "msgpack", 0)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    assert list(Recording(packed).sets()) == sound
