"""A rig's status in which every figure is there and no two are alike."""

from dataclasses import asdict, fields
from pathlib import Path

from rig_calib.drift.watch import CameraDrift, DriftStatus, PairDrift
from rig_protocol.clock_sync import ClockEstimate
from rig_protocol.counters import CameraCounters
from rig_protocol.frames import RgbdFrame
from rig_protocol.recorder import RecordingStatus
from rig_server.assembler import SetRecord
from rig_server.durations import Durations
from rig_server.metrics import CameraMetrics, DriftReport, RigStatus

MS = 1_000_000


def full_durations() -> Durations:
    """One frame (30 ms to arrive, 4 ms to decode) and one set (8 ms, spread 25 ms, uncertain by 80 µs)."""
    made = Durations()
    made.frame_decoded(RgbdFrame(0, 1, 0, received_ns=30 * MS), 34 * MS)
    made.set_delivered(SetRecord(42 * MS, 25 * MS, (), 80_000, 34 * MS))
    return made


def full_camera(camera_id: int = 0) -> CameraMetrics:
    """Its counters are 1, 2, 3, ... in the order of their fields, plus 1000 for each camera before it."""
    first = 1 + 1000 * camera_id
    counters = CameraCounters(*range(first, first + len(fields(CameraCounters))))
    return CameraMetrics(
        camera_id,
        f"cam{camera_id:02d}",
        connected=camera_id == 0,
        fps=29.97,
        frames=counters.frames,
        lost=counters.lost,
        resent=counters.resent,
        clock_error_us=45.0,
        temperature_c=61.5,
        counters=asdict(counters),
        dropped={"late": 7, "undecodable": 8, "not_decoded_in_time": 9},
        gauges={"temperature_c": 61.5, "source_skipped": 12.0, 'odd "name"\n': 13.0},
        clock=ClockEstimate(-5_000_000, -12.5, 45_000, 310_000, 240),
    )


def full_drift() -> DriftStatus:
    """Camera 1 has moved, and its overlap with camera 0 shows it."""
    moved = CameraDrift(1, "moved", 0.52, 6.25, 0.01, 0.3, "its own view")
    return DriftStatus((CameraDrift(0, "in place"), moved), (PairDrift(0, 1, 7.5, 0.21),), 0.4, 61)


def full_status() -> RigStatus:
    """Two cameras, of which the second is away."""
    durations = full_durations().snapshot()
    return RigStatus(
        (full_camera(0), full_camera(1)),
        complete=901,
        partial=17,
        sets_per_s=29.9,
        spread_ms=25.1,
        often_missing=(1,),
        dropped={
            "incomplete sets": 21,
            "sets not taken": 22,
            "frames left out of sets": 23,
            "frames of implausible time": 24,
            "frames not decoded in time": 18,
            "datagrams by the kernel": 25,
            "answers that the network refused": 26,
        },
        repeated=27,
        rejected={"bad_magic": 31, "unknown_session": 32},
        queues={"decoder": 3, "synchroniser": 5, "sets": 1},
        unread_bytes=4096,
        durations=durations,
        recent=durations,
        drift=DriftReport(full_drift(), {0: "cam00", 1: "cam01"}, passed_over=41),
        recording=RecordingStatus(Path("takes/a.mcap"), 62.0, 1860, 3_100_000_000, 43, 44, 10**12),
        link="12 cameras at 30 fps need 72.1 MB/s, 60% of the link",
    )
