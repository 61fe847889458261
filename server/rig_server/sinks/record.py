"""The recording sink: encoded frames and the sets made of them onto the disk, in a thread of its own."""

import threading
from pathlib import Path

from rig_protocol.frames import PanoramicFrame
from rig_protocol.recorder import Recorder, RecordingStatus, TakeContext
from rig_protocol.recording_format import Entry, RecordedSet
from rig_server.config import RecordingSettings
from rig_server.receiver import rig_time_ns


class RecordSink:
    """Records between `start` and `stop`, by rig_protocol/recorder.py; who gives it frames never waits."""

    def __init__(self, path: Path, settings: RecordingSettings, context: TakeContext) -> None:
        """Open the file; ConfigurationError when it exists, or cannot be written."""
        self._recorder = Recorder(path, settings, context, threading.Condition(), rig_time_ns)
        self._thread = threading.Thread(target=self._recorder.run, name="recorder", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def stop(self) -> None:
        """Write what waits and end the file in order; harmless when already stopped."""
        self._recorder.stop()
        self._thread.join()

    def add(self, entry: Entry) -> None:
        """Take a frame as it came, or what else belongs into the file."""
        self._recorder.add(entry)

    def add_set(self, panorama: PanoramicFrame, taken_ns: int) -> None:
        """Take a set as it goes out."""
        self._recorder.add(RecordedSet.of(panorama, taken_ns))

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until most of the queue is free, for who can; False when it is not in time."""
        return self._recorder.wait_for_room(timeout_s)

    def status(self) -> RecordingStatus:
        """How the recording is, at this moment; any thread may ask."""
        return self._recorder.status()
