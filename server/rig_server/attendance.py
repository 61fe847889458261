"""Which cameras the rig expects, which are here, and what to tell the operator about the others."""

from collections.abc import Collection, Iterable

from rig_protocol.events import HelloRefused
from rig_server.config import RigSettings

# A ring whose size nobody stated is taken as whole when nobody joined for so long.
SETTLED_S = 3.0


def is_whole(settings: RigSettings, connected: Collection[int], since_last_join_s: float) -> bool:
    """True when every expected camera is connected; a rig of unstated size is whole when it has settled."""
    if settings.cameras:
        return all(camera.id in connected for camera in settings.cameras)
    if settings.expected_cameras is not None:
        return len(connected) >= settings.expected_cameras
    return len(connected) > 1 and since_last_join_s >= SETTLED_S


def absent_names(settings: RigSettings, connected: Collection[int]) -> list[str]:
    """Names of the expected cameras that are not connected."""
    if settings.cameras:
        return [camera.label for camera in settings.cameras if camera.id not in connected]
    missing = max((settings.expected_cameras or 2) - len(connected), 0)
    free = (slot for slot in range(len(connected) + missing) if slot not in connected)
    return [f"cam{slot:02d}" for slot, _ in zip(free, range(missing), strict=False)]


def absence_message(
    settings: RigSettings, connected: Collection[int], refused: Iterable[HelloRefused]
) -> str:
    """Who is not here, what was refused meanwhile, and what to do."""
    absent = absent_names(settings, connected)
    who = f"{len(absent)} of {len(connected) + len(absent)} cameras have not come: {', '.join(absent)}"
    advice = (
        "On their machines look at `systemctl status 'rig-agent@*'`, at `server` in "
        "`rig-agent --print-config`, and at power and network cables"
    )
    refusals = [f"refused {event.address[0]}: {event.text}" for event in refused]
    return "\n".join([f"{who}. {advice}", *refusals])
