"""Rules of projector groups: neighbours never project at once, sets are merged, and nobody is left dark."""

import contextlib
from collections.abc import Collection, Mapping

import numpy as np
import pytest

from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import ControlAnswered, Outcome
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing
from rig_server import Rig
from rig_server.config import CaptureSettings, RigSettings, RingSettings
from rig_server.grouped_sets import GroupedSets, SetSource, sets_of
from rig_server.projector_groups import assign_groups
from rig_server.receiver import rig_time_ns
from support.small_agent import SmallAgent


def ring(cameras: int, step_deg: float | None = None) -> RigDescription:
    """A ring by its drawing; without a step nobody knows the poses."""
    drawing = None if step_deg is None else RingDrawing(yaw_step_deg=step_deg)
    return RigDescription(
        tuple(
            CameraEntry(i, f"cam{i:02d}", CameraModel(), None if drawing is None else drawing.T_rig_camera(i))
            for i in range(cameras)
        ),
        drawing,
    )


def angle_deg(description: RigDescription, i: int, j: int) -> float:
    axes = [camera.T_rig_camera[:3, 2] for camera in description.cameras if camera.T_rig_camera is not None]
    return float(np.rad2deg(np.arccos(np.clip(axes[i] @ axes[j], -1, 1))))


@pytest.mark.parametrize(
    ("cameras", "step_deg", "groups"),
    [(12, 30.0, 2), (12, 30.0, 3), (4, 30.0, 2), (9, 40.0, 3), (24, 15.0, 3)],
)
def test_no_two_of_a_group_see_the_same_wall(cameras: int, step_deg: float, groups: int) -> None:
    description = ring(cameras, step_deg)
    assigned = assign_groups(description, groups)
    assert sorted(i for group in assigned for i in group) == list(range(cameras))
    for group in assigned:
        assert all(angle_deg(description, i, j) > 43.0 + 1.0 for i in group for j in group if i != j)
    sizes = [len(group) for group in assigned]
    assert max(sizes) - min(sizes) <= 1


def test_without_a_drawing_neighbours_are_those_whose_ids_follow_one_another() -> None:
    assert assign_groups(ring(6), 2) == ((0, 2, 4), (1, 3, 5))
    assert assign_groups(ring(1), 2) == ((0,),)


@pytest.mark.parametrize(("description", "groups"), [(ring(5), 2), (ring(9, 40.0), 2), (ring(24, 15.0), 2)])
def test_too_few_groups_are_refused_with_what_would_do(description: RigDescription, groups: int) -> None:
    with pytest.raises(ConfigurationError, match="use 3"):
        assign_groups(description, groups)


class FakeRing:
    """Four cameras whose every set is of now; depth is where it was switched on."""

    ended = False

    def __init__(self, stubborn: Mapping[int, Outcome] | None = None) -> None:
        self.description = ring(4, 30.0)
        self.hellos = {i: type("Hello", (), {"depth_codecs": (5,)}) for i in range(4)}
        self.on = set(range(4))
        self.closed = False
        self.stubborn = stubborn or {}
        self.sets = 0
        self.together: set[tuple[int, int]] = set()

    def control(self, cameras: Collection[int], name: str, value: bool) -> dict[int, ControlAnswered]:
        assert name == "depth"
        assert not self.closed
        obedient = set(cameras) - self.stubborn.keys()
        self.on = self.on | obedient if value else self.on - obedient
        outcomes = {i: self.stubborn.get(i, Outcome.DONE) for i in cameras}
        return {i: ControlAnswered(i, 0, outcome, "in words") for i, outcome in outcomes.items()}

    def next_panorama(self, timeout_s: float) -> PanoramicFrame:  # noqa: ARG002  # it never waits
        self.together |= {(i, i + 1) for i in range(3) if {i, i + 1} <= self.on}
        self.sets += 1
        raw = np.zeros((1, 1), np.uint16)
        stamp_ns = rig_time_ns()
        frames = {
            i: RgbdFrame(
                i, self.sets, stamp_ns, bayer=raw.astype(np.uint8), raw=raw if i in self.on else None
            )
            for i in range(4)
        }
        return PanoramicFrame.of(self.sets, frames)

    def end_sets(self) -> None:
        self.closed = True


def grouped(rig: FakeRing, frames: int = 3) -> GroupedSets:
    return GroupedSets(rig, CaptureSettings(frames=frames, projector_groups=2))  # type: ignore[arg-type]


def take(sets: SetSource, count: int) -> list[PanoramicFrame]:
    taken: list[PanoramicFrame] = []
    while len(taken) < count:
        panorama = sets.next_panorama(0.0)
        taken += [] if panorama is None else [panorama]
    return taken


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig_server.grouped_sets._SETTLING_NS", 1_000_000)


def test_every_frame_of_a_merged_set_has_depth_and_no_neighbours_projected_together() -> None:
    rig = FakeRing()
    for panorama in take(grouped(rig), 3):
        assert panorama.complete
        frames = [frame for frame in panorama.frames.values() if frame is not None]
        assert all(frame.raw is not None and frame.bayer is not None for frame in frames)
    assert rig.together == set()
    assert rig.on == set(range(4))


def test_a_camera_that_projects_out_of_turn_is_switched_off_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig_server.grouped_sets._SWITCH_AGAIN_S", 0.0)
    rig = FakeRing()
    sets = grouped(rig)
    sets.next_panorama(0.0)
    rig.on.add(1)  # its session ended for a moment
    for panorama in take(sets, 3):
        stamps = {i: frame.sequence for i, frame in panorama.frames.items() if frame is not None}
        assert stamps[0] == stamps[2] != stamps[1] == stamps[3]
    assert rig.on == set(range(4))


def test_a_capture_that_is_interrupted_leaves_nobody_dark() -> None:
    rig = FakeRing()
    settings = CaptureSettings(projector_groups=2)
    with contextlib.suppress(KeyboardInterrupt), sets_of(rig, settings) as sets:  # type: ignore[arg-type]
        sets.next_panorama(0.0)
        assert rig.on == {0, 2}
        raise KeyboardInterrupt
    assert rig.on == set(range(4))


def test_an_interruption_while_switching_leaves_nobody_dark(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = FakeRing()

    def interrupted(cameras: Collection[int], name: str, value: bool) -> None:
        monkeypatch.undo()
        rig.control(cameras, name, value)  # it was done, and nobody heard of it
        raise KeyboardInterrupt

    settings = CaptureSettings(projector_groups=2)
    monkeypatch.setattr(rig, "control", interrupted)
    with pytest.raises(KeyboardInterrupt), sets_of(rig, settings) as sets:  # type: ignore[arg-type]
        sets.next_panorama(0.0)
    assert rig.on == set(range(4))


def test_a_camera_that_cannot_switch_ends_the_capture_with_its_name_and_the_others_shine_again() -> None:
    rig = FakeRing(stubborn={3: Outcome.REFUSED})
    settings = CaptureSettings(projector_groups=2)
    with pytest.raises(RigError, match="camera 3: in words"), sets_of(rig, settings) as sets:  # type: ignore[arg-type]
        sets.next_panorama(0.0)
    assert rig.on == set(range(4))


def test_the_projectors_shine_again_before_the_rig_is_closed() -> None:
    rig = FakeRing()
    sets = grouped(rig)
    sets.next_panorama(0.0)
    sets.end_sets()
    assert rig.closed
    assert rig.on == set(range(4))


def test_one_group_is_the_rig_itself() -> None:
    rig = FakeRing()
    with sets_of(rig, CaptureSettings()) as sets:  # type: ignore[arg-type]
        assert sets is rig


def test_agents_on_loopback_project_in_turns() -> None:
    settings = RigSettings(
        listen="127.0.0.1:0",
        insecure=True,
        expected_cameras=3,
        ring=RingSettings(),
        capture=CaptureSettings(frames=2, projector_groups=2),
    )
    with Rig.live(settings) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        address = host, int(port)
        with SmallAgent(0, address) as first, SmallAgent(1, address) as second, SmallAgent(2, address):
            rig.wait_for_cameras(10)
            with sets_of(rig, settings.capture) as sets:
                panoramas = take(sets, 2)
    assert all(panorama.complete for panorama in panoramas)
    assert first.done == [("depth", True), ("depth", False), ("depth", True)]
    assert second.done == [("depth", False), ("depth", True)]
