"""The rig before calibration: rig.toml and hellos."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig_protocol.camera import CameraModel, Intrinsics, RawDepthModel
from rig_protocol.messages import Hello
from rig_protocol.poses import Pose
from rig_server.config import CameraSettings, RigSettings, RingSettings
from rig_server.description import camera_names, describe_rig


def pose(x_m: float) -> Pose:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


FACTORY = CameraModel(
    Intrinsics(524, 524, 318, 241),
    Intrinsics(577, 577, 314, 238),
    pose(-0.0249),
    RawDepthModel(346, 1088),
    "factory",
)


def hello(name: str = "pi") -> Hello:
    return Hello(name, None, None, None, CameraModel(source="factory"), (1,), (2,), 30.0, "test 1")


def test_a_listed_name_comes_before_the_agents_and_that_before_the_slots() -> None:
    settings = RigSettings(cameras=(CameraSettings(id=0, name="door"), CameraSettings(id=1)))
    names = camera_names(settings, {0: hello("zero"), 2: hello("two")})
    assert names == {0: "door", 1: "cam01", 2: "two"}


def test_a_name_that_is_taken_or_unfit_for_a_file_gives_way_to_the_slots() -> None:
    hellos = {0: hello("twin"), 1: hello("twin"), 2: hello("../../etc/passwd"), 3: hello("a b")}
    assert camera_names(RigSettings(), hellos) == {0: "twin", 1: "cam01", 2: "cam02", 3: "cam03"}


def test_a_name_that_looks_like_another_slot_does_not_collide() -> None:
    names = camera_names(RigSettings(), {0: hello("cam01"), 1: hello("a b")})
    assert len(set(names.values())) == 2


def test_cameras_carry_the_agents_model_and_no_pose_without_a_drawing() -> None:
    description = describe_rig(RigSettings(), {3: hello(), 1: hello("one")})
    assert description.camera_ids == (1, 3)
    assert description.camera(3).model.source == "factory"
    assert description.camera(3).T_rig_camera is None
    assert description.ring is None


def test_the_drawing_gives_nominal_poses() -> None:
    settings = RigSettings(ring=RingSettings(radius_m=0.3))
    description = describe_rig(settings, {0: hello(), 3: hello("three")})
    assert description.ring is not None
    T = description.camera(3).T_rig_camera
    assert T is not None
    np.testing.assert_allclose(T[:3, 3], [0, 0.3, 0], atol=1e-12)


def described_with_file(folder: Path, measured: CameraModel, told: CameraModel) -> CameraModel:
    """The model of a camera with an intrinsics file whose agent tells another one."""
    path = folder / "cam00.json"
    path.write_text(json.dumps(measured.to_dict()))
    settings = RigSettings(cameras=(CameraSettings(id=0, intrinsics=path),))
    return describe_rig(settings, {0: replace(hello(), model=told)}).camera(0).model


def test_measured_intrinsics_come_before_the_agents(tmp_path: Path) -> None:
    measured = CameraModel(
        Intrinsics(531.5, 531.0, 320, 240),
        Intrinsics(575, 575, 310, 242),
        pose(0.024),
        RawDepthModel(350, 1090),
        "file",
    )
    assert described_with_file(tmp_path, measured, FACTORY).to_dict() == measured.to_dict()


@pytest.mark.parametrize("depth", [None, CameraModel().depth], ids=["no depth side", "the defaults"])
def test_what_a_file_did_not_measure_stays_the_agents(tmp_path: Path, depth: Intrinsics | None) -> None:
    measured = CameraModel(Intrinsics(531.5, 531.0, 320, 240), depth, source="file")
    model = described_with_file(tmp_path, measured, FACTORY)
    assert model.to_dict() == replace(FACTORY, color=measured.color, source="file").to_dict()
