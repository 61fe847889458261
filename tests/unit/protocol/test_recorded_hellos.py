"""The agents of a take come back as they were told; what a file says of them is hostile."""

import json
from typing import Any

import pytest

from rig_protocol.camera import CameraModel
from rig_protocol.errors import DataError
from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import recorded_hellos, told_hellos
from rig_protocol.rig_folder import CameraEntry, RigDescription

RIG = RigDescription((CameraEntry(3, "cam03", CameraModel()),))
HELLO = Hello("cam03", 3, "K1", None, RIG.cameras[0].model, (1, 2), (), 30.0, "kinect-rig 1.2.3")


def told(**changes: Any) -> Any:
    document = json.loads(json.dumps(told_hellos({3: HELLO})))
    document["agents"][0] |= changes
    return document


def test_an_agent_comes_back_as_it_was_told() -> None:
    back = recorded_hellos(told(), RIG)[3]
    names = (
        "name",
        "camera_id",
        "serial",
        "port_path",
        "model",
        "color_codecs",
        "depth_codecs",
        "fps",
        "software",
    )
    assert [getattr(back, name) for name in names] == [getattr(HELLO, name) for name in names]


@pytest.mark.parametrize(
    "document",
    [
        [],
        {"agents": {}},
        {"agents": [3]},
        told(camera_id=4),
        told(fps=10**400),
        told(fps=float("inf")),
        told(fps=True),
        told(color_codecs=[0]),
        told(name="x" * 65),
    ],
)
def test_a_malformed_document_is_refused_in_words(document: Any) -> None:
    with pytest.raises(DataError):
        recorded_hellos(document, RIG)
