"""Where the operator reads on: the entries of docs/troubleshooting.md, by their anchors.

An error carries its topic (errors.py), a line of the log gets one by `extra=see(topic)`; programs.py
prints both.
"""

from enum import StrEnum

_PAGE = "docs/troubleshooting.md"


class Topic(StrEnum):
    """The entries; the page has a heading for each."""

    NO_KINECT = "no-kinect"
    NO_PERMISSION = "no-permission"
    KINECT_IN_USE = "kinect-in-use"
    HANGING_KINECT = "hanging-kinect"
    MISSING_LIBRARY = "missing-library"
    POWER = "power"
    NO_FRAMES = "no-frames"
    LOW_RATE = "low-rate"
    TORN_FRAMES = "torn-frames"
    LOST_FRAMES = "lost-frames"
    LATE_SETS = "late-sets"
    INCOMPLETE_SETS = "incomplete-sets"
    MISSING_CAMERA = "missing-camera"
    AGENT_REFUSED = "agent-refused"
    RIG_KEY = "rig-key"
    SERVER_SILENT = "server-silent"
    NO_NETWORK = "no-network"
    PORT_IN_USE = "port-in-use"
    SMALL_RECEIVE_BUFFER = "small-receive-buffer"
    UNCERTAIN_CLOCK = "uncertain-clock"
    CLOCK_DISAGREEMENT = "clock-disagreement"
    TILTED_CLOUD = "tilted-cloud"
    CALIBRATION_REFUSED = "calibration-refused"
    CAMERA_MOVED = "camera-moved"
    FULL_DISK = "full-disk"
    WRONG_SETTINGS = "wrong-settings"
    DAMAGED_FILES = "damaged-files"
    OTHER_FAILURES = "other-failures"


def reference(topic: Topic) -> str:
    """What stands after a message."""
    return f"see {_PAGE}#{topic}"


def see(topic: Topic) -> dict[str, Topic]:
    """The `extra` of a line of the log that has an entry."""
    return {"topic": topic}
