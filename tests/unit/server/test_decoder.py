"""Payloads become frames, on threads, in order and within bounds."""

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from queue import Queue

import numpy as np
import pytest

from rig_agent.encoder import encode_frame
from rig_protocol.codecs import codec_by_name
from rig_protocol.errors import DataError
from rig_protocol.frames import EncodedFrame, Payload, RgbdFrame
from rig_protocol.gravity import Gravity
from rig_server.decoder import FrameDecoder, decode_frame
from support.images import scene

BAYER, RAW = codec_by_name("bayer-lossless").id, codec_by_name("disparity-lossless").id
WAIT_S = 20.0


def encoded(camera_id: int, sequence: int) -> EncodedFrame:
    frame = RgbdFrame(camera_id, sequence, sequence, bayer=scene("bayer", 32, 32), raw=scene("raw", 32, 32))
    return encode_frame(frame, BAYER, RAW)


def undecodable(camera_id: int) -> EncodedFrame:
    return EncodedFrame(camera_id, 0, 0, color=Payload(BAYER, b"garbage"))


class Results:
    """Takes what the decoder delivers; can hold its threads back."""

    def __init__(self) -> None:
        self.frames: Queue[RgbdFrame] = Queue()
        self.entered = threading.Semaphore(0)
        self.gate = threading.Event()
        self.gate.set()

    def __call__(self, frame: RgbdFrame) -> None:
        self.entered.release()
        assert self.gate.wait(WAIT_S)
        self.frames.put(frame)

    def take(self, count: int) -> list[tuple[int, int]]:
        frames = [self.frames.get(timeout=WAIT_S) for _ in range(count)]
        return [(frame.camera_id, frame.sequence) for frame in frames]


@pytest.fixture
def results() -> Results:
    return Results()


@pytest.fixture
def start(results: Results) -> Iterator[Callable[..., FrameDecoder]]:
    decoders: list[FrameDecoder] = []

    def make(**options: int) -> FrameDecoder:
        decoders.append(FrameDecoder(results, **options))
        return decoders[-1]

    yield make
    results.gate.set()
    for decoder in decoders:
        decoder.close()


@pytest.mark.parametrize(
    ("frame", "color", "depth"),
    [
        (RgbdFrame(1, 2, 3, 4, bayer=scene("bayer", 48, 64), raw=scene("raw", 48, 64)), 1, 32),
        (RgbdFrame(1, 2, 3, 4, color=scene("bgr", 48, 64), depth_mm=scene("depth_mm", 48, 64)), 2, 33),
        (RgbdFrame(1, 2, 3, 4, color=scene("grey", 48, 64), depth_frame="color", damaged=True), 3, 33),
    ],
    ids=["bayer+disparity", "bgr+millimetres", "grey"],
)
def test_a_frame_comes_back_as_it_was(frame: RgbdFrame, color: int, depth: int) -> None:
    decoded = decode_frame(encode_frame(frame, color, depth))
    for field in RgbdFrame.__slots__:
        np.testing.assert_array_equal(getattr(decoded, field), getattr(frame, field), strict=True)


@pytest.mark.parametrize("shape", [(48, 64), (1, 1), (3, 2)])
def test_demosaicing_adds_colour_beside_the_mosaic_and_changes_nothing_else(shape: tuple[int, int]) -> None:
    frame = RgbdFrame(1, 2, 3, bayer=np.full(shape, 9, np.uint8), raw=scene("raw", *shape))
    plain, demosaiced = (decode_frame(encode_frame(frame, BAYER, RAW), wanted) for wanted in (False, True))
    assert plain.color is None
    assert demosaiced.color is not None
    assert demosaiced.color.shape == (*shape, 3)
    assert shape != (48, 64) or (demosaiced.color == 9).all()
    for field in set(RgbdFrame.__slots__) - {"color"}:
        np.testing.assert_array_equal(getattr(demosaiced, field), getattr(plain, field), strict=True)


def test_demosaicing_leaves_frames_that_have_colour_alone() -> None:
    frame = RgbdFrame(1, 2, 3, color=scene("bgr", 48, 64))
    np.testing.assert_array_equal(
        decode_frame(encode_frame(frame, 2, None), demosaic=True).color, frame.color
    )


def test_a_codec_of_the_other_stream_is_a_data_error() -> None:
    payload = encoded(0, 0).depth
    with pytest.raises(DataError, match="none of this stream's"):
        decode_frame(EncodedFrame(0, 0, 0, color=payload))


def test_frames_of_one_camera_come_out_in_order(start: Callable[..., FrameDecoder], results: Results) -> None:
    decoder = start(threads=4, capacity=100)
    for sequence in range(50):
        decoder.submit(encoded(7, sequence))
    assert results.take(50) == [(7, sequence) for sequence in range(50)]


def test_frames_of_two_cameras_are_decoded_at_the_same_time(
    start: Callable[..., FrameDecoder], results: Results
) -> None:
    results.gate.clear()
    decoder = start(threads=2)
    for camera_id in (0, 0, 1):
        decoder.submit(encoded(camera_id, 0))
    for _ in range(2):
        assert results.entered.acquire(timeout=WAIT_S)
    results.gate.set()
    assert sorted(results.take(3)) == [(0, 0), (0, 0), (1, 0)]


def test_overload_drops_the_oldest_waiting_frame_and_counts_it(
    start: Callable[..., FrameDecoder], results: Results
) -> None:
    results.gate.clear()
    decoder = start(threads=1, capacity=3)
    decoder.submit(encoded(0, 0))
    assert results.entered.acquire(timeout=WAIT_S)  # the thread is held; what follows has to wait
    for camera_id in range(1, 6):
        decoder.submit(encoded(camera_id, 0))
    assert decoder.dropped_by_camera == {1: 1, 2: 1}
    assert decoder.dropped == 2
    results.gate.set()
    assert results.take(4) == [(0, 0), (3, 0), (4, 0), (5, 0)]


def test_an_undecodable_frame_is_counted_and_the_next_ones_are_delivered(
    start: Callable[..., FrameDecoder], results: Results
) -> None:
    decoder = start(threads=1)
    for frame in (undecodable(4), undecodable(4), encoded(4, 1), undecodable(5), encoded(5, 2)):
        decoder.submit(frame)
    assert results.take(2) == [(4, 1), (5, 2)]
    assert decoder.undecodable_by_camera == {4: 2, 5: 1}
    assert decoder.undecodable == 3


def test_a_fault_of_the_owner_is_logged_and_decoding_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    delivered: Queue[int] = Queue()

    def deliver(frame: RgbdFrame) -> None:
        if frame.sequence == 0:
            raise RuntimeError("a bug")
        delivered.put(frame.sequence)

    decoder = FrameDecoder(deliver, threads=1)
    with caplog.at_level(logging.ERROR):
        decoder.submit(encoded(0, 0))
        decoder.submit(encoded(0, 1))
        assert delivered.get(timeout=WAIT_S) == 1
    decoder.close()
    assert "camera 0, frame 0 is lost" in caplog.text


def test_closing_forgets_what_waits_and_waits_for_what_runs(
    start: Callable[..., FrameDecoder], results: Results
) -> None:
    results.gate.clear()
    decoder = start(threads=1)
    decoder.submit(encoded(0, 0))
    assert results.entered.acquire(timeout=WAIT_S)
    decoder.submit(encoded(0, 1))
    closing = threading.Thread(target=decoder.close)
    closing.start()
    closing.join(0.05)
    assert closing.is_alive()
    results.gate.set()
    closing.join(WAIT_S)
    assert not closing.is_alive()
    decoder.submit(encoded(0, 2))
    decoder.close()
    assert results.take(1) == [(0, 0)]
    assert results.frames.empty()


@pytest.mark.parametrize("options", [{"threads": 0}, {"capacity": 0}])
def test_a_decoder_without_threads_or_room_is_refused(options: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        FrameDecoder(lambda _: None, **options)


def test_a_frame_keeps_what_is_known_beside_its_images() -> None:
    felt = Gravity((0.0, 1.0, 0.0))
    frame = decode_frame(replace(encoded(3, 5), uncertainty_ns=7, received_ns=9, damaged=True, gravity=felt))
    assert (frame.camera_id, frame.sequence, frame.uncertainty_ns, frame.received_ns) == (3, 5, 7, 9)
    assert (frame.damaged, frame.gravity) == (True, felt)
