"""What the operator of a running server may ask, and the answers: plain values that JSON can hold."""

from collections.abc import Mapping
from typing import Any

from rig_protocol.errors import ConfigurationError
from rig_protocol.messages import ControlValue
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
            case other:
                raise ConfigurationError(f"this server cannot do {other!r}: its release is another")

    def _control(self, request: Request) -> Answer:
        names = self._names()
        camera, name, value = request.get("camera"), request.get("name"), request.get("value")
        if not isinstance(name, str) or not isinstance(value, ControlValue):
            raise ConfigurationError("a control has a name, and a value that is a switch, a number or a word")
        chosen = None if camera == ALL else _camera_id(camera, names)
        answers = self._rig.control(chosen, name, value)
        return {
            "results": [
                {"camera": i, "name": names.get(i, str(i)), "outcome": one.outcome.value, "text": one.text}
                for i, one in sorted(answers.items())
            ]
        }

    def _agents(self) -> Answer:
        hellos = self._rig.hellos
        return {
            "cameras": [
                {
                    "camera": camera.camera_id,
                    "name": camera.name,
                    "connected": camera.connected,
                    "fps": round(camera.fps, 1),
                    "serial": hellos[camera.camera_id].serial if camera.camera_id in hellos else None,
                    "port_path": hellos[camera.camera_id].port_path if camera.camera_id in hellos else None,
                }
                for camera in self._rig.status().cameras
            ]
        }

    def _names(self) -> dict[int, str]:
        return {camera.camera_id: camera.name for camera in self._rig.status().cameras}


def _camera_id(camera: Any, names: Mapping[int, str]) -> int:
    """A camera by id or name; ConfigurationError names those that there are."""
    for camera_id, name in names.items():
        if str(camera) in (str(camera_id), name):
            return camera_id
    known = ", ".join(f"{name} ({camera_id})" for camera_id, name in sorted(names.items())) or "none yet"
    raise ConfigurationError(f"there is no camera {camera!r}: this rig has {known}, or write {ALL}")
