"""The rig's state as the page shows it: plain values that JSON can hold."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from rig_calib.coaching import PairSupport
from rig_calib.drift.words import moved_message
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.messages import Hello
from rig_protocol.recorder import RecordingStatus
from rig_server.health_history import QUANTITIES, HealthHistory
from rig_server.histogram import HistogramSnapshot
from rig_server.metrics import CameraMetrics, RigStatus
from rig_server.session_view import Phase, SessionView
from rig_server.sinks.fuse import FusionReport
from rig_server.status_words import alarms, summary

RIG = "rig"  # stands where a camera's id would


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """Everything that the page's state is made of.

    `away_s`: for how long cameras gave no frame, by id. `tiles_trouble`: why there are no tiles.
    """

    place: str
    ended: bool
    status: RigStatus
    hellos: Mapping[int, Hello]
    calibration: RigCalibration | None
    session: SessionView
    fusion: FusionReport
    latency: HistogramSnapshot
    health: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    away_s: Mapping[int, float] = field(default_factory=dict)
    orders: bool = True
    tiles_trouble: str | None = None


def page_state(moment: Moment) -> dict[str, Any]:
    """What the page is told a few times a second."""
    status = moment.status
    figures, troubles = summary(status)
    if moment.tiles_trouble is not None:
        troubles.append(f"pictures of the cameras: {moment.tiles_trouble}")
    return {
        "kind": "state",
        "place": moment.place,
        "ended": moment.ended,
        "orders": moment.orders,
        "connected": status.connected,
        "sets_per_s": status.sets_per_s,
        "spread_ms": status.spread_ms,
        "figures": figures,
        "troubles": troubles,
        "alarms": alarms(status),
        "watched": status.drift is not None,
        "cameras": [_camera(camera, moment) for camera in status.cameras],
        "health": moment.health,
        "recording": _recording(status.recording),
        "calibration": _calibration(moment.calibration),
        "fusion": asdict(moment.fusion),
        "session": session_state(moment.session),
        "latency": latency_state(moment.latency),
    }


def latest_health(history: HealthHistory, camera_ids: tuple[int, ...]) -> dict[str, dict[str, float | None]]:
    """The newest value of every quantity, by camera id or RIG; None where unknown."""
    latest: dict[str, dict[str, float | None]] = {}
    for name in QUANTITIES:
        latest[name] = {
            place: (plain(values[-1]) if len(values) else None)
            for place, (_, values) in _series(history, name, camera_ids).items()
        }
    return latest


def health_history(history: HealthHistory, camera_ids: tuple[int, ...], now_s: float) -> dict[str, Any]:
    """All of it: ages in seconds, and by quantity and camera id (or RIG) the values."""
    answer: dict[str, Any] = {"quantities": {name: asdict(one) for name, one in QUANTITIES.items()}}
    series = {name: _series(history, name, camera_ids) for name in QUANTITIES}
    times = max((t for of in series.values() for t, _ in of.values()), key=len, default=())
    answer["ages_s"] = [round(now_s - float(t), 1) for t in times]
    answer["series"] = {
        name: {place: [plain(value) for value in values] for place, (_, values) in of.items()}
        for name, of in series.items()
    }
    return answer


def session_state(view: SessionView) -> dict[str, Any]:
    """A calibration that runs, waits for its decision, or ended."""
    return {
        "phase": view.phase,
        "busy": view.phase in (Phase.WAITING, Phase.COLLECTING, Phase.SOLVING),
        "sets": view.sets,
        "wanted": view.wanted,
        "stage": view.stage,
        "share": view.share,
        "headline": view.headline,
        "pairs": [_pair(pair) for pair in view.pairs],
        "failures": list(view.failures),
        "missed": view.missed,
        "moved": {str(camera): list(map(plain, by)) for camera, by in view.moved.items()},
        "message": view.message,
    }


def latency_state(seen: HistogramSnapshot) -> dict[str, Any]:
    """From the last datagram of a frame to its tile on the page, in ms."""
    quantiles = {name: seen.quantile_ns(share) for name, share in (("p50_ms", 0.5), ("p95_ms", 0.95))}
    told = {name: None if ns is None else round(ns / 1e6, 1) for name, ns in quantiles.items()}
    return {"tiles": seen.count, **told}


def plain(value: float) -> float | None:
    """A number that JSON knows."""
    return round(float(value), 4) if math.isfinite(value) else None


def _series(history: HealthHistory, name: str, camera_ids: tuple[int, ...]) -> dict[str, Any]:
    if QUANTITIES[name].of == RIG:
        return {RIG: history.series(name)}
    return {str(camera_id): history.series(name, camera_id) for camera_id in camera_ids}


def _camera(camera: CameraMetrics, moment: Moment) -> dict[str, Any]:
    drift, hello = moment.status.drift, moment.hellos.get(camera.camera_id)
    moved = [] if drift is None else [one for one in drift.status.moved if one.camera == camera.camera_id]
    return {
        "id": camera.camera_id,
        "name": camera.name,
        "connected": camera.connected,
        "frames": camera.frames,
        "lost": camera.lost,
        "damaged": camera.damaged,
        "corrupt": camera.corrupt,
        "late": camera.late,
        "resent": camera.resent,
        "serial": None if hello is None else hello.serial,
        "port_path": None if hello is None else hello.port_path,
        "away_s": moment.away_s.get(camera.camera_id),
        "placed": moment.calibration is not None and camera.camera_id in moment.calibration.poses,
        "moved": None if not moved or drift is None else moved_message(moved[0], drift.names),
    }


def _recording(recording: RecordingStatus | None) -> dict[str, Any] | None:
    if recording is None:
        return None
    return {
        "file": recording.path.name,
        "seconds": recording.seconds,
        "bytes": recording.bytes,
        "bytes_per_s": recording.bytes_per_s,
        "free_bytes": recording.free_bytes,
        "frames": recording.frames,
        "dropped": recording.dropped,
        "ended": recording.ended,
    }


def _calibration(calibration: RigCalibration | None) -> dict[str, Any] | None:
    if calibration is None:
        return None
    return {"created": calibration.created, "method": calibration.method, "cameras": len(calibration.poses)}


def _pair(pair: PairSupport) -> dict[str, Any]:
    expected = pair.expected
    return {
        "name": pair.name,
        "matches": pair.matches,
        "deg": None if expected is None else plain(expected.deg),
        "mm": None if expected is None else plain(expected.mm),
        "support": pair.support,
        "advice": pair.advice,
    }
