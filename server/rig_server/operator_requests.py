"""What the operator of a running server may ask, and the answers: plain values that JSON can hold."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from rig_protocol.errors import ConfigurationError
from rig_protocol.messages import ControlValue
from rig_protocol.roster import Slot
from rig_server.config import MAX_CAMERAS
from rig_server.operator_socket import Answer, Request
from rig_server.rig import Rig

ALL = "all"


class OperatorRequests:
    """Answers requests about one rig, on any thread."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig

    def __call__(self, request: Request) -> Answer:
        """ConfigurationError for a request that makes no sense."""
        match request.get("do"):
            case "control":
                return self._control(request)
            case "agents":
                return self._agents()
            case "assign":
                return self._assign(request)
            case other:
                raise ConfigurationError(f"this server cannot do {other!r}: its release is another")

    def _control(self, request: Request) -> Answer:
        names = self._names()
        camera, name, value = request.get("camera"), request.get("name"), request.get("value")
        if not isinstance(name, str) or not isinstance(value, ControlValue):
            raise ConfigurationError("a control has a name, and a value that is a switch, a number or a word")
        chosen = None if camera == ALL else find_camera_id(camera, names)
        answers = self._rig.control(chosen, name, value)
        return {
            "results": [
                {"camera": i, "name": names.get(i, str(i)), "outcome": one.outcome.value, "text": one.text}
                for i, one in sorted(answers.items())
            ]
        }

    def _assign(self, request: Request) -> Answer:
        slot, name = request.get("slot"), request.get("name")
        serial, port_path = request.get("serial"), request.get("port_path")
        texts = [text for text in (name, serial, port_path) if text is not None]
        if type(slot) is not int or not 0 <= slot < MAX_CAMERAS or not all(isinstance(t, str) for t in texts):
            raise ConfigurationError(f"a slot is a number from 0 to {MAX_CAMERAS - 1}, all else is text")
        self._rig.assign(Slot(slot, name or f"cam{slot:02d}", serial, port_path))
        return {}

    def _agents(self) -> Answer:
        hellos, status = self._rig.hellos, self._rig.status()
        return {
            "unassigned": [asdict(agent) for agent in status.unassigned],
            "cameras": [
                {
                    "camera": camera.camera_id,
                    "name": camera.name,
                    "connected": camera.connected,
                    "fps": round(camera.fps, 1),
                    "serial": hellos[camera.camera_id].serial if camera.camera_id in hellos else None,
                    "port_path": hellos[camera.camera_id].port_path if camera.camera_id in hellos else None,
                }
                for camera in status.cameras
            ],
        }

    def _names(self) -> dict[int, str]:
        return {camera.camera_id: camera.name for camera in self._rig.status().cameras}


def find_camera_id(camera: Any, names: Mapping[int, str]) -> int:
    """A camera by id or name; ConfigurationError names those that there are."""
    told = str(camera)
    ids = [camera_id for camera_id in names if told == str(camera_id)]  # a name may be another one's number
    found = ids or [camera_id for camera_id, name in names.items() if told == name]
    if found:
        return found[0]
    known = ", ".join(f"{name} ({camera_id})" for camera_id, name in sorted(names.items())) or "none yet"
    raise ConfigurationError(f"there is no camera {camera!r}: this rig has {known}, or write {ALL}")
