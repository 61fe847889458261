"""A real server as a process that tells what it delivers: one JSON line a set, one of its counters a second.

python tests/support/set_server.py SETTINGS.json

SETTINGS.json holds rig settings. A line is {"t": monotonic seconds, "missing": [...]} or
{"t": ..., "status": {...}}.
SIGUSR1 and SIGUSR2 set this process's clock one hour ahead and back (support/stepping_clock.py).
"""

import json
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_server import Rig
from rig_server.config import RigSettings
from support.stepping_clock import true_time_s

_STATUS_EVERY_S = 1.0


def main() -> None:
    """Serve until killed."""
    settings = RigSettings.model_validate_json(Path(sys.argv[1]).read_text())
    with Rig.live(settings) as rig:
        threading.Thread(target=_tell_status, args=(rig,), daemon=True).start()
        _tell({"ready": True})
        while True:
            panorama = rig.next_panorama(0.5)
            if panorama is not None:
                _tell({"missing": panorama.missing})


def _tell_status(rig: Rig) -> None:
    while True:
        time.sleep(_STATUS_EVERY_S)
        _tell({"status": asdict(rig.status()), "resident_kib": _resident_kib()})


def _tell(what: dict[str, object]) -> None:
    # One write: lines of two threads must not mix.
    sys.stdout.write(json.dumps({"t": true_time_s(), **what}) + "\n")
    sys.stdout.flush()


def _resident_kib() -> int:
    fields = Path("/proc/self/status").read_text().split("VmRSS:")[1].split()
    return int(fields[0])


if __name__ == "__main__":
    main()
