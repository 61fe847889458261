"""Rules of the history of health: honest about what is unknown, never negative, bounded."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig_calib.drift.watch import CameraDrift, DriftStatus
from rig_protocol.recorder import RecordingStatus
from rig_server.health_history import QUANTITIES, HealthHistory
from rig_server.metrics import CameraMetrics, DriftReport, RigStatus
from support.full_status import full_status


def camera(frames: int, lost: int = 0, camera_id: int = 0, connected: bool = True) -> CameraMetrics:
    return CameraMetrics(camera_id, f"cam{camera_id:02d}", connected, fps=30.0, frames=frames, lost=lost)


def history_of(*statuses: tuple[CameraMetrics, ...], seconds: float = 600.0) -> HealthHistory:
    """One sample a second."""
    history = HealthHistory(seconds)
    for k, cameras in enumerate(statuses):
        history.sample(RigStatus(cameras), 100.0 + k)
    return history


def values(history: HealthHistory, quantity: str, camera_id: int | None = None) -> list[float | None]:
    """None for what is unknown."""
    _, found = history.series(quantity, camera_id)
    return [None if np.isnan(value) else round(float(value), 6) for value in found]


def test_loss_is_that_of_the_last_interval_not_since_the_start() -> None:
    history = history_of((camera(1000, 1000),), (camera(1030, 1000),), (camera(1045, 1015),))
    assert values(history, "loss", 0) == [None, 0.0, 0.5]


def test_an_agent_that_begins_anew_has_lost_nothing_by_that() -> None:
    """Its counters jump back to zero."""
    history = history_of((camera(1000, 500),), (camera(20, 0),), (camera(27, 3),))
    assert values(history, "loss", 0) == [None, 0.0, 0.3]
    assert values(history, "damaged", 0) == [None, 0.0, 0.0]


def test_nothing_is_known_of_an_interval_in_which_nothing_was_sent() -> None:
    assert values(history_of((camera(5),), (camera(5),)), "loss", 0) == [None, None]


def test_a_camera_may_come_and_leave_and_come_back() -> None:
    history = history_of(
        (camera(0),),
        (camera(30), camera(9, camera_id=1)),
        (camera(60, connected=False), camera(39, camera_id=1)),
        (camera(60), camera(39, 30, camera_id=1)),
    )
    assert values(history, "fps", 0) == [30.0, 30.0, None, 30.0]
    assert values(history, "fps", 1) == [None, 30.0, 30.0, 30.0]
    assert values(history, "loss", 0) == [None, 0.0, None, None], "what went on while it was away is unknown"
    assert values(history, "loss", 1) == [None, None, 0.0, 1.0]


def test_a_camera_that_nobody_knows_is_unknown_at_the_same_times() -> None:
    history = history_of((camera(0),), (camera(30),))
    time_s, unknown = history.series("fps", 7)
    assert time_s.tolist() == [100.0, 101.0]
    assert np.isnan(unknown).all()


def test_the_oldest_samples_make_room_and_the_order_stays() -> None:
    history = history_of(*[(camera(30 * k),) for k in range(25)], seconds=10.0)
    time_s, fps = history.series("fps", 0)
    assert time_s.tolist() == [100.0 + k for k in range(15, 25)]
    assert fps.tolist() == [30.0] * 10


def test_what_left_the_window_is_forgotten() -> None:
    """Memory does not grow with the number of cameras that were ever here."""
    history = HealthHistory(seconds=5.0)
    for k in range(40):
        history.sample(RigStatus((camera(0, camera_id=k),)), float(k))
    assert len(history._values) <= 1 + 5


def test_it_samples_no_more_often_than_it_should_however_often_it_is_asked_to() -> None:
    history = HealthHistory(every_s=1.0)
    for k in range(41):
        history.sample(RigStatus((camera(k),)), 0.25 * k)
    time_s, _ = history.series("fps", 0)
    assert np.diff(time_s).tolist() == [1.0] * 10


def test_every_quantity_is_there_where_the_status_has_it() -> None:
    history = HealthHistory()
    before = full_status()
    recording = RecordingStatus(Path("a.mcap"), bytes=3_102_000_000)
    history.sample(replace(before, recording=replace(recording, bytes=3_100_000_000)), 1.0)
    first = before.cameras[0]
    later = replace(first, frames=first.frames + 30, damaged=first.damaged + 2)
    drift = DriftReport(DriftStatus((CameraDrift(0, "moved", 0.5, 6.0), CameraDrift(1, "learning"))), {})
    history.sample(
        replace(before, cameras=(later, replace(later, camera_id=1)), recording=recording, drift=drift), 3.0
    )
    latest = {
        name: values(history, name, 0 if quantity.of == "camera" else None)[-1]
        for name, quantity in QUANTITIES.items()
    }
    assert latest == {
        "fps": 29.97,
        "loss": 0.0,
        "damaged": 1.0,
        "temperature_c": 61.5,
        "clock_error_us": 45.0,
        "drift_mm": 6.0,
        "drift_deg": 0.5,
        "sets_per_s": 29.9,
        "spread_ms": 25.1,
        "record_mb_s": 1.0,
    }
    assert values(history, "drift_mm", 1) == [None, None], "a watch that learns knows nothing yet"


def test_another_recording_begins_at_zero() -> None:
    history = HealthHistory()
    for second, recording in enumerate(
        [RecordingStatus(Path("a"), bytes=9_000_000), RecordingStatus(Path("b"), bytes=2_000_000), None]
    ):
        history.sample(RigStatus((), recording=recording), float(second))
    assert values(history, "record_mb_s") == [None, 2.0, None]


def test_a_quantity_of_each_camera_needs_one() -> None:
    with pytest.raises(ValueError, match="name one"):
        HealthHistory().series("fps")
    with pytest.raises(KeyError):
        HealthHistory().series("mood")
