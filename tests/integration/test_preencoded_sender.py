"""The benchmarks' load: what it plays arrives whole, and stands in for real frames where there are none."""

import numpy as np
import pytest

from rig_protocol.codecs import codec_by_name
from rig_protocol.key_file import read_key
from support.images import mosaic
from support.key_for_tests import rig_key_file
from support.loopback_server import LoopbackServer
from support.preencoded_frames import ImagePair, encode_frames, recorded_images, synthetic_images
from support.preencoded_sender import Play, encoded_file, sender_process, total


@pytest.mark.parametrize("paced", [True, False])
def test_every_frame_of_every_camera_arrives_as_it_was_encoded(paced: bool) -> None:
    key = read_key(rig_key_file())
    with LoopbackServer(rig_key=key) as server, encoded_file() as (file, frames):
        play = Play("{}:{}".format(*server.address), (3, 5), seconds=0.5, paced=paced)
        with sender_process(play, file) as sender:
            result = sender.result()
        assert [total(result, name) for name in ("submitted", "sent", "dropped", "unheard")] == [30, 30, 0, 0]
        received = {(frame.camera_id, frame.sequence): frame for frame in server.frames()}
        assert sorted(received) == [(camera, k) for camera in (3, 5) for k in range(15)]
        for (camera, k), frame in received.items():
            sent = frames.frame(camera, k, 0)
            assert (frame.color, frame.depth) == (sent.color, sent.depth)


def test_uncompressed_frames_have_the_size_that_the_paper_sends() -> None:
    assert encode_frames("rgb24").frame_bytes == pytest.approx(640 * 480 * 5, rel=1e-4)


def test_synthetic_frames_pack_within_a_tenth_of_the_size_of_recorded_ones() -> None:
    assert packed_kib(synthetic_images()) == pytest.approx(packed_kib(recorded_images()), rel=0.1)


def packed_kib(images: list[ImagePair]) -> float:
    """Mean size of the Bayer image and of the disparity, together."""
    color, depth = codec_by_name("bayer-lossless"), codec_by_name("disparity-lossless")
    return float(np.mean([len(color.encode(mosaic(c))) + len(depth.encode(d)) for c, d in images])) / 1024
