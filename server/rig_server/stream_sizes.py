"""How large encoded images are: what to expect before the first has come, and what is measured then."""

from rig_protocol.codecs import codec, codec_by_name
from rig_protocol.codecs.raw import UncompressedCodec
from rig_protocol.frames import EncodedFrame

_PIXELS = 640 * 480
# KiB of a 640×480 image: (mean of the real frames of docs/performance.md, pure noise). The scene decides
# what is between.
_KIB = {
    "bayer-lossless": (167.5, 301),
    "bgr-lossless": (410.8, 901),
    "grey-lossless": (119.0, 301),
    "bgr-jpeg": (59.9, 271),
    "grey-jpeg": (49.8, 238),
    "disparity-lossless": (36.9, 450),
    "depth-lossless": (42.7, 545),
}
_BYTES_PER_PIXEL = {"bayer": 1, "grey": 1, "bgr": 3, "raw": 2, "depth_mm": 2}

_KNOWN_AFTER = 4  # images; the first after a start may be dark
_WINDOW = 8  # images that a mean reaches back: a quarter of a second at 30 frames/s
# A codec that is no longer in use: so long its last sizes say more than what we expect of any scene.
_MEMORY_NS = 60_000_000_000


def expected_bytes(codec_id: int, pixels: int) -> float:
    """What an image of so many pixels takes, going by real frames."""
    return _kib_of_vga(codec_id)[0] * 1024 * pixels / _PIXELS


def worst_bytes(codec_id: int, pixels: int) -> float:
    """What it takes when it is nothing but noise."""
    return _kib_of_vga(codec_id)[1] * 1024 * pixels / _PIXELS


def planned_bytes(codec_id: int, pixels: int, margin: float) -> float:
    """What to plan for: `margin` times the expectation, never beyond the worst case."""
    return min(margin * expected_bytes(codec_id, pixels), worst_bytes(codec_id, pixels))


def paper_bytes() -> int:
    """A frame of the paper: RGB24 and 16-bit depth, uncompressed."""
    return round(expected_bytes(codec_by_name("bgr-uncompressed").id, _PIXELS)) + 2 * _PIXELS


def _kib_of_vga(codec_id: int) -> tuple[float, float]:
    one = codec(codec_id)
    if isinstance(one, UncompressedCodec):
        exact = _BYTES_PER_PIXEL[one.image] * _PIXELS / 1024
        return exact, exact
    return _KIB[one.name]


class MeasuredSizes:
    """Mean sizes of the latest images of one camera, by codec."""

    def __init__(self) -> None:
        self._means: dict[int, _RunningMean] = {}  # at most one for each codec there is

    def add(self, frame: EncodedFrame, now_ns: int) -> None:
        """Count a frame that came; cheap."""
        for payload in (frame.color, frame.depth):
            if payload is not None:
                mean = self._means.get(payload.codec_id)
                if mean is None:
                    mean = self._means[payload.codec_id] = _RunningMean()
                mean.add(len(payload.data), now_ns)

    def mean(self, codec_id: int, now_ns: int) -> float | None:
        """Bytes of an image; None when too few came, or none for a minute."""
        mean = self._means.get(codec_id)
        if mean is None or mean.count < _KNOWN_AFTER or now_ns - mean.last_ns > _MEMORY_NS:
            return None
        return mean.value


class _RunningMean:
    """Exponential, but for the first few, which weigh the same."""

    __slots__ = ("count", "last_ns", "value")

    def __init__(self) -> None:
        self.count, self.value, self.last_ns = 0, 0.0, 0

    def add(self, size: int, now_ns: int) -> None:
        if now_ns - self.last_ns > _MEMORY_NS:
            self.count = 0
        self.count += 1
        self.last_ns = now_ns
        self.value += (size - self.value) / min(self.count, _WINDOW)
