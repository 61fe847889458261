"""The recording of a rig: begun and ended by anybody, at most one at a time."""

import threading
from collections.abc import Callable
from pathlib import Path

from rig_protocol.errors import RigError
from rig_protocol.recorder import RecordingStatus, TakeContext
from rig_server.config import RecordingSettings
from rig_server.sinks.record import RecordSink


class TakeRecording:
    """Holds the recorder while there is one; whoever has frames asks for `sink` each time."""

    def __init__(self, settings: RecordingSettings, context: Callable[[], TakeContext]) -> None:
        """`context` is asked for when a recording begins."""
        self._settings, self._context = settings, context
        self._changing = threading.Lock()  # one thread at a time starts or ends a recording
        self.sink: RecordSink | None = None

    def start(self, take: Path) -> None:
        """Record to a new file from now on.

        ConfigurationError when it exists or cannot be written, RigError while another recording runs.
        """
        with self._changing:
            if self.sink is not None and self.sink.status().ended is None:
                raise RigError(f"{self.sink.status().path} is being recorded: stop that first")
            sink = RecordSink(take, self._settings, self._context())
            sink.start()
            self.sink = sink

    def stop(self) -> RecordingStatus | None:
        """End the recording in order; how it was, None where nobody recorded."""
        with self._changing:
            sink, self.sink = self.sink, None
            if sink is None:
                return None
            sink.stop()
            return sink.status()

    def status(self) -> RecordingStatus | None:
        """How it is at this moment, None where nobody records."""
        sink = self.sink
        return None if sink is None else sink.status()
