"""What pages are told: everything that the rig knows, in numbers that JSON has."""

import json
from dataclasses import replace

import numpy as np

from rig_calib.accuracy import Accuracy
from rig_calib.coaching import PairSupport, Support
from rig_server.console.state import Moment, health_history, latest_health, page_state
from rig_server.health_history import QUANTITIES, HealthHistory
from rig_server.histogram import Histogram
from rig_server.metrics import DriftReport
from rig_server.session_view import Phase, SessionView
from rig_server.sinks.fuse import FusionReport
from support.box_room import calibration_of, ring_poses
from support.full_status import full_drift, full_status

NAMES = {0: "cam00", 1: "cam01"}


def a_moment(**changes: object) -> Moment:
    latency = Histogram([50_000_000, 100_000_000])
    latency.observe(40_000_000)
    moment = Moment(
        place="UDP 127.0.0.1:4012",
        ended=False,
        status=replace(full_status(), drift=DriftReport(full_drift(), NAMES)),
        hellos={},
        calibration=calibration_of(ring_poses(2)),
        session=SessionView(),
        fusion=FusionReport(),
        latency=latency.snapshot(),
        away_s={0: 0.1},
    )
    return replace(moment, **changes)  # type: ignore[arg-type]


def told(moment: Moment) -> dict[str, object]:
    return json.loads(json.dumps(page_state(moment), allow_nan=False))  # type: ignore[no-any-return]


def test_every_camera_is_told_with_what_is_wrong_with_it() -> None:
    cameras = told(a_moment())["cameras"]
    assert isinstance(cameras, list)
    assert [(one["name"], one["connected"], one["placed"]) for one in cameras] == [
        ("cam00", True, True),
        ("cam01", False, True),
    ]
    assert cameras[0]["moved"] is None
    assert "cam01" in cameras[1]["moved"]
    assert cameras[1]["away_s"] is None


def test_without_calibration_recording_and_pictures_it_says_so() -> None:
    state = told(a_moment(calibration=None, latency=Histogram([1]).snapshot()))
    assert state["calibration"] is None
    assert state["latency"] == {"tiles": 0, "p50_ms": None, "p95_ms": None}


def test_a_session_is_told_with_its_coach() -> None:
    pairs = (
        PairSupport(0, 1, "cam00–cam01", 120, True, Accuracy(0.05, 2.5), Support.GOOD),
        PairSupport(1, 2, "cam01–cam02", 0, False, None, Support.NOTHING, "hang a pattern"),
    )
    session = told(a_moment(session=SessionView(Phase.SOLVING, 2, 5, pairs=pairs, moved={1: (0.5, 3.0)})))
    told_session = session["session"]
    assert isinstance(told_session, dict)
    assert told_session["busy"] is True
    assert told_session["moved"] == {"1": [0.5, 3.0]}
    assert [(pair["support"], pair["mm"]) for pair in told_session["pairs"]] == [
        ("good", 2.5),
        ("nothing", None),
    ]


def test_what_cannot_be_estimated_is_unknown_and_silences_no_page() -> None:
    """A browser's JSON has no NaN: one of them and it shows nothing of the state."""
    unknown = PairSupport(0, 1, "cam00–cam01", 3, True, Accuracy(np.nan, np.inf), Support.WEAK)
    session = SessionView(Phase.READY, pairs=(unknown,), moved={1: (np.nan, 3.0)})
    told_session = told(a_moment(session=session))["session"]
    assert isinstance(told_session, dict)
    assert (told_session["pairs"][0]["deg"], told_session["pairs"][0]["mm"]) == (None, None)
    assert told_session["moved"] == {"1": [None, 3.0]}


def test_why_there_are_no_pictures_is_told() -> None:
    assert "trouble" not in str(told(a_moment())["troubles"])
    assert "pictures of the cameras: a trouble" in str(told(a_moment(tiles_trouble="a trouble"))["troubles"])


def test_health_is_told_by_camera_and_what_is_unknown_is_no_number() -> None:
    history = HealthHistory()
    for second in range(3):
        history.sample(full_status(), float(second))
    answer = json.loads(json.dumps(health_history(history, (0, 1), 3.0), allow_nan=False))
    assert set(answer["series"]) == set(QUANTITIES)
    assert answer["series"]["temperature_c"]["0"] == [61.5, 61.5, 61.5]
    assert len(answer["series"]["sets_per_s"]["rig"]) == 3
    latest = latest_health(history, (0, 1, 9))
    assert latest["temperature_c"]["0"] == 61.5
    assert latest["temperature_c"]["9"] is None
    assert np.isclose(latest["sets_per_s"]["rig"] or 0, 29.9)
