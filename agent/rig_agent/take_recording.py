"""One camera's take on this machine's own disk: every frame of its source, whatever the network carries.

Frames keep agent time. What ties it to other clocks is noted twice a second, for `rig-calib merge`.
"""

import importlib.util
import threading
import time
from dataclasses import replace
from datetime import UTC as UTC_ZONE
from datetime import datetime
from pathlib import Path
from typing import Any

from rig_agent.config import AgentSettings
from rig_agent.hello import make_hello
from rig_agent.sources.base import SourceDescription
from rig_agent.transport import now_ns
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import EncodedFrame
from rig_protocol.recorded_hellos import told_hellos
from rig_protocol.recorder import Recorder, RecordingStatus, TakeContext
from rig_protocol.recording import DESCRIPTION, HELLOS, SETTINGS
from rig_protocol.recording_format import AGENT, UTC, ClockReading, ClockTie
from rig_protocol.rig_folder import CameraEntry, RigDescription
from rig_protocol.system_clock import SystemClock


class TakeRecording:
    """Records between `start` and `stop` in a thread of its own; who gives it frames never waits."""

    def __init__(self, settings: AgentSettings, path: Path) -> None:
        """Open the file, or a new one in the folder `path`; ConfigurationError where that is not possible."""
        if importlib.util.find_spec("mcap") is None:
            raise ConfigurationError("recording needs the package mcap: install kinect-rig[agent]")
        self._settings = settings
        self._documents: dict[str, Any] = {
            SETTINGS: settings.model_dump(mode="json", exclude={"key_file"}),
        }
        self._system_clock = SystemClock(now_ns, time.time_ns)
        self._camera_id: int | None = None
        self.rig_tie: ClockTie | None = None
        """What the server says of its clock against ours; set by whoever hears it."""
        context = TakeContext(lambda: self._documents, reading=self._reading, clock=AGENT)
        target = _target(path, settings.display_name(settings.camera))
        self._recorder = Recorder(target, settings.record, context, threading.Condition(), now_ns)
        self._thread = threading.Thread(target=self._recorder.run, name="recorder", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def stop(self) -> None:
        """Write what waits and end the file in order; harmless when already stopped."""
        self._recorder.stop()
        self._thread.join()

    def describe(self, source: SourceDescription) -> None:
        """The camera that comes from now on; ConfigurationError when nothing says which slot it has."""
        hello = make_hello(self._settings, source)
        if hello.camera_id is None:
            raise ConfigurationError("a take tells cameras apart by their slots: give --camera, or `camera`")
        camera = CameraEntry(hello.camera_id, hello.name, source.model)
        self._documents = self._documents | {
            DESCRIPTION: RigDescription((camera,)).to_dict(),
            HELLOS: told_hellos({hello.camera_id: replace(hello, fps=source.fps)}),
        }
        self._camera_id = hello.camera_id

    def add(self, frame: EncodedFrame) -> None:
        """Take a frame in agent time."""
        if self._camera_id is not None:
            self._recorder.add(replace(frame, camera_id=self._camera_id))

    def add_dropped(self, timestamp_ns: int) -> None:
        """Note a frame that the encoder was too slow for."""
        if self._camera_id is not None:
            self._recorder.add_dropped(self._camera_id, timestamp_ns)

    def status(self) -> RecordingStatus:
        """How the recording is, at this moment; any thread may ask."""
        return self._recorder.status()

    def _reading(self) -> ClockReading | None:
        """Agent time against the clocks that are known now."""
        wall, rig_tie = self._system_clock.read(), self.rig_tie
        ties = () if rig_tie is None else (rig_tie,)
        if wall.error_ns is not None:
            ties = (*ties, ClockTie(UTC, wall.wall_minus_monotonic_ns, wall.error_ns))
        return ClockReading(now_ns(), ties) if ties else None


def _target(path: Path, name: str) -> Path:
    """The file to record to; ConfigurationError for what was meant as a folder, and is none."""
    if path.is_dir():
        return _new_file(path, name)
    if path.suffix != ".mcap":
        raise ConfigurationError(f"{path} is no folder: make it (mkdir -p {path}), or name a file FILE.mcap")
    return path


def _new_file(folder: Path, name: str) -> Path:
    """A name that is not taken: a service that starts anew begins a new take, whatever its clock says."""
    begun = f"{name}-{datetime.now(UTC_ZONE):%Y%m%dT%H%M%SZ}"
    names = (f"{begun}.mcap" if k == 0 else f"{begun}-{k}.mcap" for k in range(10_000))
    return next(path for one in names if not (path := folder / one).exists())
