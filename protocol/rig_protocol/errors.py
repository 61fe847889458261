"""Errors that a caller may catch.

RigError                    the work failed; the message says what happened and what to do   (exit status 1)
├── ConfigurationError      a setting, an option or a file the user wrote is wrong            (exit status 2)
├── DataError               a file or a payload does not hold what its format promises
└── LinkUsageError          a link was used against its contract (a programming mistake)

What arrives from the wire never raises out of a link: it is dropped and counted.
"""

from rig_protocol.troubleshooting import Topic


class RigError(Exception):
    """The work failed. The message says what happened and what to do, the topic where to read on."""

    exit_status = 1
    topic = Topic.OTHER_FAILURES

    def __init__(self, message: str = "", topic: Topic | None = None) -> None:
        """Without `topic`, that of the class."""
        super().__init__(message)
        if topic is not None:
            self.topic = topic


class ConfigurationError(RigError):
    """A setting, an option or a file that the user wrote is wrong."""

    exit_status = 2
    topic = Topic.WRONG_SETTINGS


class DataError(RigError):
    """A file or a payload does not hold what its format promises."""

    topic = Topic.DAMAGED_FILES


class LinkUsageError(RigError):
    """A link was used against its contract, for example a frame sent before the welcome."""
