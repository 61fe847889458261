"""Rig: panoramic frames as a Python iterator, live, recorded or simulated alike."""

import re
import secrets
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.events import ControlAnswered
from rig_protocol.frames import PanoramicFrame
from rig_protocol.key_file import rig_key
from rig_protocol.messages import ControlValue, Hello
from rig_protocol.poses import Pose
from rig_protocol.recorder import RecordingStatus
from rig_protocol.rig_folder import RigDescription
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Slot
from rig_protocol.troubleshooting import Topic
from rig_server.config import MAX_CAMERAS, RigSettings, load_rig_settings, parse_address
from rig_server.metrics import RigStatus
from rig_server.pipeline import LivePipeline
from rig_server.recorded import RecordedRig
from rig_server.replay import ReplayedRig, ReplayOptions
from rig_server.simulation import SIMULATED_FPS, Simulation, simulated_settings
from rig_server.sinks.watch import WatchSink

_POLL_S = 0.25  # how soon a dead thread or a dead simulated agent is noticed while nothing comes
_LIVE_SOURCE = re.compile(r"(udp|simulated):(?://)?(.*)")


class Feed(Protocol):
    """Where the panoramic frames of a rig come from."""

    @property
    def source(self) -> str:
        """`udp`, `folder` or `recording`, for the provenance of a result."""
        ...

    @property
    def place(self) -> str:
        """Where the frames come from, for the operator."""
        ...

    @property
    def description(self) -> RigDescription:
        """The cameras known so far."""
        ...

    @property
    def hellos(self) -> Mapping[int, Hello]:
        """What the agents said of themselves, by camera id; empty where there are none."""
        ...

    @property
    def ended(self) -> bool:
        """True when no panoramic frame will come any more."""
        ...

    calibration: RigCalibration | None
    """The one in force: at first that of a recorded take; others put another one. A recording embeds it."""

    def start(self) -> None:
        """Begin."""
        ...

    def end_sets(self) -> None:
        """No more sets are needed; what is recorded stays open. Harmless when already ended."""
        ...

    def stop(self) -> None:
        """End; harmless when already ended."""
        ...

    def absence(self) -> str | None:
        """Which expected cameras are not here and what to do; None when all are."""
        ...

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, or None when none came in time; RigError when the feed broke."""
        ...

    def control(
        self, cameras: int | Collection[int] | None, name: str, value: ControlValue
    ) -> Mapping[int, ControlAnswered]:
        """Have these agents, or every connected one, do something; the answers by camera id."""
        ...

    def assign(self, slot: Slot) -> None:
        """Give a slot to a camera."""
        ...

    def start_recording(self, take: Path) -> None:
        """Record to a new file from now on."""
        ...

    def stop_recording(self) -> RecordingStatus | None:
        """End the recording in order; how it was."""
        ...

    def status(self) -> RigStatus:
        """The rig at this moment."""
        ...


class Rig:
    """A ring of cameras. `with Rig.open(...) as rig: for panorama in rig: ...`

    Open it with `Rig.open` or `Rig.simulated`; it runs from `with` to the end of the block.
    """

    def __init__(self, feed: Feed, settings: RigSettings, simulation: Simulation | None = None) -> None:
        self.settings = settings
        self._feed = feed
        self._simulation = simulation
        self._swapping = threading.Lock()  # one thread at a time begins, swaps or ends the drift watch
        self._running = False
        self._watch: WatchSink | None = None
        self._offers: list[Callable[[PanoramicFrame], None]] = []
        if settings.watch.calibration is not None:
            self.put_in_force(_watched_calibration(settings.watch.calibration), watch=True)

    @classmethod
    def open(cls, source: str | Path, settings: RigSettings | None = None) -> Self:
        """A rig from `udp://HOST:PORT` (listen there), `simulated:N`, a rig folder, or a recording FILE.mcap.

        Settings: None reads rig.toml as `rig-server` does. ConfigurationError when the source makes no sense.
        """
        settings = settings or load_rig_settings(None)
        match = _LIVE_SOURCE.fullmatch(str(source))
        if match is None and Path(source).suffix == ".mcap":
            return cls.replayed(Path(source), settings)
        if match is None:
            return cls(RecordedRig(Path(source)), settings)
        kind, rest = match.groups()
        if kind == "udp":
            return cls.live(_listening_at(rest, settings))
        if not rest.isdecimal() or not 0 < int(rest) <= MAX_CAMERAS:
            raise ConfigurationError(f"{source!r}: write simulated:N with N cameras, at most {MAX_CAMERAS}")
        return cls.simulated(int(rest), settings=settings)

    @classmethod
    def live(cls, settings: RigSettings, record: Path | None = None) -> Self:
        """The agents that stream to this machine, at the address that the settings state.

        `record`: a new file to record the take to (docs/recording.md).
        """
        return cls(LivePipeline(settings, rig_key(settings.key_file, settings.insecure), record), settings)

    @classmethod
    def replayed(
        cls,
        take: Path,
        settings: RigSettings,
        options: ReplayOptions | None = None,
        record: Path | None = None,
    ) -> Self:
        """A recorded take; the default options play it once, at the speed at which it was recorded.

        `record`: a new file to record to what is played.
        ConfigurationError when there is no such file, DataError when it is no recording.
        """
        return cls(ReplayedRig(take, settings, options or ReplayOptions(), record), settings)

    @classmethod
    def simulated(
        cls,
        cameras: int = 12,
        seed: int = 0,
        fps: float = SIMULATED_FPS,
        settings: RigSettings | None = None,
        record: Path | None = None,
    ) -> Self:
        """A ring of simulated agents: processes of this machine that stream over loopback UDP."""
        settings = simulated_settings(settings or load_rig_settings(None), cameras)
        key = RigKey.generate(secrets.token_bytes)
        pipeline = LivePipeline(settings, key, record)
        return cls(pipeline, settings, Simulation(cameras, seed, fps, pipeline.address, key))

    def __enter__(self) -> Self:
        """Begin."""
        try:
            if self._simulation is not None:
                self._simulation.start()
            with self._swapping:
                self._running = True
                if self._watch is not None:
                    self._watch.start()
            self._feed.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End."""
        self.close()

    def __iter__(self) -> Iterator[PanoramicFrame]:
        """Panoramic frames as they come; without end when live."""
        while not self.ended:
            panorama = self.next_panorama(_POLL_S)
            if panorama is not None:
                yield panorama

    def close(self) -> None:
        """End; harmless when already ended."""
        try:
            self._feed.stop()  # first: agents that we end ourselves are no news
        finally:  # also when somebody loses patience and presses Ctrl-C again
            with self._swapping:
                self._running = False
                if self._watch is not None:
                    self._watch.stop()
            if self._simulation is not None:
                self._simulation.close()

    def end_sets(self) -> None:
        """End what makes sets: no more are needed. A recording stays open until `close`, for what follows."""
        self._feed.end_sets()
        if self._simulation is not None:
            self._simulation.close()

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set; None when none came within `timeout_s`. RigError when the rig broke."""
        if self._simulation is not None:
            self._simulation.check()
        panorama = self._feed.next_panorama(timeout_s)
        watch = self._watch  # others swap it
        if panorama is not None and watch is not None:
            watch.offer(panorama, lambda: self.description)
        if panorama is not None:
            for offer in self._offers:
                offer(panorama)
        return panorama

    def on_set(self, offer: Callable[[PanoramicFrame], None]) -> None:
        """Hand every set that is taken from now on to `offer`, too, which must not wait."""
        self._offers.append(offer)

    def wait_for_cameras(
        self, timeout_s: float = 60.0, on_wait: Callable[[RigStatus], None] | None = None
    ) -> None:
        """Return when every expected camera is connected; `on_wait` is called a few times a second.

        RigError names those that did not come within `timeout_s`.
        """
        until_s = time.monotonic() + timeout_s
        while (absence := self._feed.absence()) is not None:
            if self._simulation is not None:
                self._simulation.check()
            if time.monotonic() >= until_s:
                raise RigError(f"after {timeout_s:.0f} s {absence}", Topic.MISSING_CAMERA)
            if on_wait is not None:
                on_wait(self.status())
            time.sleep(_POLL_S)

    def control(
        self, cameras: int | Collection[int] | None, name: str, value: ControlValue
    ) -> Mapping[int, ControlAnswered]:
        """Have cameras (None: every connected one) do something, and wait; answers by camera id.

        Names and values are those of docs/control.md. Any thread may ask. ConfigurationError for what cannot
        be told at all; what an agent refuses is an outcome, no error. RigError for a recording.
        """
        return self._feed.control(cameras, name, value)

    def assign(self, slot: Slot) -> None:
        """Give a slot to a camera, until the rig ends (`rig-server assign` writes rig.toml, too)."""
        self._feed.assign(slot)

    def start_recording(self, take: Path) -> None:
        """Record to a new file from now on; any thread may ask.

        ConfigurationError when it exists or cannot be written; RigError while another recording runs, and
        for a rig that is no live one.
        """
        self._feed.start_recording(take)

    def stop_recording(self) -> RecordingStatus | None:
        """End the recording in order and say how it was; None where nobody recorded."""
        return self._feed.stop_recording()

    @property
    def calibration(self) -> RigCalibration | None:
        """The one in force: that which is watched over, that of a replayed take, or the one put in force."""
        return self._feed.calibration

    def put_in_force(self, calibration: RigCalibration, watch: bool = False) -> None:
        """Go by this calibration from now on; any thread may say so.

        A recording that runs embeds it. Where a drift watch runs, or `watch` asks for one, it begins anew
        with this calibration, and this returns when the one before has ended its look.
        """
        with self._swapping:
            before = self._watch
            if watch or before is not None:
                fresh = WatchSink(calibration, self.settings.watch.every)
                if self._running:
                    fresh.start()
                self._watch = fresh
            self._feed.calibration = calibration
        if before is not None:
            before.stop()

    @property
    def description(self) -> RigDescription:
        """The cameras that have come so far, their models, and nominal poses where the drawing is known."""
        return self._feed.description

    @property
    def source(self) -> str:
        """`udp`, `folder` or `recording`."""
        return self._feed.source

    @property
    def place(self) -> str:
        """Where the frames come from, in words."""
        return self._feed.place

    @property
    def hellos(self) -> Mapping[int, Hello]:
        """What the agents said of themselves, by camera id; empty for a rig folder."""
        return self._feed.hellos

    @property
    def ended(self) -> bool:
        """True when a recording was read to its end; a live rig never ends."""
        return self._feed.ended

    def status(self) -> RigStatus:
        """Rates and losses of every camera, and of the sets."""
        status, watch = self._feed.status(), self._watch
        return status if watch is None else replace(status, drift=watch.report())

    def true_poses(self) -> Mapping[int, Pose] | None:
        """True T_rig_camera by camera id; None where nobody knows them."""
        return None if self._simulation is None else self._simulation.true_poses()


def _watched_calibration(file: Path) -> RigCalibration:
    """The calibration that settings ask to watch over; ConfigurationError when it cannot be read."""
    try:
        return RigCalibration.load(file)
    except DataError as error:
        raise ConfigurationError(f"watch.calibration: {error}") from error


def _listening_at(address: str, settings: RigSettings) -> RigSettings:
    try:
        parse_address(address)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    return settings.model_copy(update={"listen": address})
