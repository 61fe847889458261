"""An encoder's memory stays in the process."""

import platform
import resource

import pytest

from rig_protocol.codecs import codec_by_name, keep_freed_memory
from support.images import scene


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps memory as it likes")
def test_an_encoder_at_a_steady_pace_takes_no_new_pages() -> None:
    keep_freed_memory()
    images = {
        name: scene(kind, 480, 640)
        for name, kind in (("bayer-lossless", "bayer"), ("disparity-lossless", "raw"))
    }

    def page_faults_of(pairs: int) -> int:
        before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
        for _ in range(pairs):
            for name, image in images.items():
                codec_by_name(name).encode(image)
        return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before

    page_faults_of(3)
    assert (
        page_faults_of(5) < 5 * 50
    )  # more than a thousand a pair where freed memory goes back to the kernel
