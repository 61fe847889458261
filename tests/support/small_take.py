"""A take of two small cameras, written as a recorder writes it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec_by_name
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import told_hellos
from rig_protocol.recording import DESCRIPTION, RecordingWriter
from rig_protocol.recording_format import Entry, RecordedSet
from rig_protocol.rig_folder import CameraEntry, RigDescription

COLOR, DEPTH = codec_by_name("bayer-uncompressed"), codec_by_name("disparity-uncompressed")
RIG = RigDescription((CameraEntry(0, "cam00", CameraModel()), CameraEntry(1, "cam01", CameraModel())))
START_NS, PERIOD_NS, TRANSIT_NS = 10_000_000_000, 100_000_000, 20_000_000


def encoded(camera_id: int, k: int) -> EncodedFrame:
    """Frame k of a camera, every pixel `10 · camera + k`; it came some milliseconds later."""
    image = np.full((48, 64), 10 * camera_id + k, np.uint8)
    time_ns = START_NS + k * PERIOD_NS + camera_id
    return EncodedFrame(
        camera_id=camera_id,
        sequence=k,
        timestamp_ns=time_ns,
        uncertainty_ns=0,
        color=Payload(COLOR.id, COLOR.encode(image)),
        depth=Payload(DEPTH.id, DEPTH.encode(image.astype(np.uint16))),
        received_ns=time_ns + TRANSIT_NS,
    )


def of_set(k: int) -> RecordedSet:
    """The set of both cameras' frames k."""
    stamps: dict[int, int | None] = {i: START_NS + k * PERIOD_NS + i for i in (0, 1)}
    return RecordedSet(k, START_NS + k * PERIOD_NS + 2 * TRANSIT_NS, stamps)


def entries(sets: int) -> list[Entry]:
    """Frames and sets as they come."""
    return [entry for k in range(sets) for entry in (encoded(0, k), encoded(1, k), of_set(k))]


def hello_documents() -> dict[str, object]:
    """What tells the agents of both cameras."""
    fps = 1e9 / PERIOD_NS
    return told_hellos(
        {i: Hello(f"cam0{i}", i, None, None, CameraModel(), (), (), fps, "test") for i in (0, 1)}
    )


def write_take(
    path: Path, taken: Sequence[Entry], finish: bool = True, flush_every: int = 3, **attached: object
) -> Path:
    """Write it, a chunk after so many entries; `finish`: with the indexes of the end."""
    with path.open("wb") as output:
        writer = RecordingWriter(output, "", 0)
        for name, values in {DESCRIPTION: RIG.to_dict(), **attached}.items():
            writer.attach(name, values, 0)
        for count, entry in enumerate(taken, 1):
            writer.write(entry)
            if count % flush_every == 0:
                writer.flush()
        if finish:
            writer.finish()
    return path
