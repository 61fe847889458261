"""The program on the PC: receive, decode and synchronise frames, then calibrate or fuse.

`from rig_server import Rig` is the Python interface; it is imported when asked for, so that
`rig-server --help` does not wait for it.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rig_server.rig import Rig

__all__ = ["Rig"]


def __getattr__(name: str) -> Any:
    if name != "Rig":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from rig_server.rig import Rig

    return Rig
