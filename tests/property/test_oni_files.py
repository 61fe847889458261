"""Any bytes as an .oni recording: passed as whole or refused in one sentence, before OpenNI2 sees them."""

import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_agent.sources.oni_file import check_recording
from rig_protocol.errors import DataError
from support.oni_writer import DEPTH_1_MM, RGB888, OniWriter

SHAPE = (4, 6)


@cache
def whole_recording() -> bytes:
    """Two small frames."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.oni"
        with OniWriter(path, [DEPTH_1_MM, RGB888], shape=SHAPE) as writer:
            for i in range(2):
                writer.write(1, i * 33_333, np.full(SHAPE, 1000, np.uint16))
                writer.write(2, i * 33_333, np.full((*SHAPE, 3), 100, np.uint8))
        return path.read_bytes()


def check(content: bytes) -> None:
    with tempfile.NamedTemporaryFile(suffix=".oni") as file:
        Path(file.name).write_bytes(content)
        check_recording(Path(file.name))


def test_a_whole_recording_passes_with_or_without_what_recorders_leave_behind_it() -> None:
    check(whole_recording())
    check(whole_recording() + bytes(4096))


def test_a_recording_cut_anywhere_is_refused() -> None:
    whole = whole_recording()
    for length in range(0, len(whole), 7):
        with pytest.raises(DataError, match=r"is torn or damaged at byte|is no OpenNI recording"):
            check(whole[:length])


@given(st.binary(max_size=400), st.booleans())
def test_any_bytes_pass_or_are_refused(content: bytes, begins_right: bool) -> None:
    with pytest.raises(DataError):
        check(whole_recording()[:24] + content if begins_right else content)


@given(st.integers(0, 10_000), st.binary(min_size=1, max_size=12))
@settings(max_examples=200)
def test_a_recording_with_overwritten_bytes_passes_or_is_refused(position: int, garbage: bytes) -> None:
    whole = whole_recording()
    position %= len(whole)
    with suppress(DataError):
        check(whole[:position] + garbage + whole[position + len(garbage) :])


@pytest.mark.parametrize("wrong", [b"xnIs\xdcenerating", b"xnIs\0enerating"])
def test_a_property_without_a_proper_name_is_refused(wrong: bytes) -> None:
    """OpenNI2's player crashes on a name that is not ASCII."""
    with pytest.raises(DataError, match="is torn or damaged"):
        check(whole_recording().replace(b"xnIsGenerating", wrong))


@pytest.mark.parametrize("streams", [1, 2**32 - 1])
def test_a_recording_that_misstates_its_streams_is_refused(streams: int) -> None:
    """OpenNI2's player makes room for as many as stated, and looks for all others beyond it."""
    whole = whole_recording()
    with pytest.raises(DataError, match="is torn or damaged"):
        check(whole[:20] + streams.to_bytes(4, "little") + whole[24:])


def test_an_uncompressed_image_of_another_size_than_stated_is_refused() -> None:
    whole = whole_recording()
    stated = b"oniRequiredFrameSize\0\x08\0\0\0"
    position = whole.index(stated) + len(stated)
    with pytest.raises(DataError, match="is torn or damaged"):
        check(whole[:position] + b"\x31" + whole[position + 1 :])
