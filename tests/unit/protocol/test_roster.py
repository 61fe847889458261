import pytest

from rig_protocol.messages import Hello, Reject, RejectReason
from rig_protocol.roster import MAX_CAMERAS, Roster, Slot, describe, known_serial
from support.wire import make_hello

LISTED = Roster(
    (
        Slot(0, "front", serial="S0"),
        Slot(1, "left", port_path="1-1.2"),
        Slot(2, "back"),
        Slot(3, "right", port_path="1-1.3"),
        Slot(4, "top", port_path="1-1.3"),
    )
)


def hello(camera_id: int | None = None, serial: str | None = None, port_path: str | None = None) -> Hello:
    return make_hello(camera_id=camera_id, serial=serial, port_path=port_path)


def refusal(roster: Roster, camera: Hello, taken: tuple[int, ...] = ()) -> str:
    answer = roster.assign(camera, None, taken)
    assert isinstance(answer, Reject)
    assert answer.reason is RejectReason.UNKNOWN_CAMERA
    return answer.text


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        (hello(2), 2),
        (hello(2, serial="anything"), 2),
        (hello(0, serial="S0"), 0),
        (hello(serial="S0"), 0),
        (hello(port_path="1-1.2"), 1),
        (hello(port_path="1-1.2.1"), 1),
        (hello(1, port_path="1-1.2.1"), 1),
        (hello(serial="S0", port_path="1-1.2"), 0),
        (hello(serial="S9", port_path="1-1.2"), 1),
    ],
)
def test_a_camera_gets_the_slot_of_its_id_else_serial_else_port_path(camera: Hello, expected: int) -> None:
    assert LISTED.assign(camera, None, ()) == expected


def test_a_slot_bound_to_one_camera_refuses_another() -> None:
    assert "slot 0 (front) is for serial S0" in refusal(LISTED, hello(0, serial="S9"))
    assert "slot 1 (left) is for port path 1-1.2" in refusal(LISTED, hello(1, port_path="1-9"))
    assert "slot 1 (left) is for port path 1-1.2" in refusal(LISTED, hello(1, port_path="1-1.20"))
    assert "slot 1 (left) is for port path 1-1.2" in refusal(LISTED, hello(1))
    assert "slot 0" in refusal(LISTED, hello(0))


@pytest.mark.parametrize("camera", [hello(9), hello(serial="S9"), hello(port_path="2-1"), hello()])
def test_a_camera_that_no_slot_fits_is_told_to_be_added(camera: Hello) -> None:
    assert "add it to the server's settings" in refusal(LISTED, camera)


def test_a_port_path_of_two_slots_decides_nothing() -> None:
    assert "that of 2 slots" in refusal(LISTED, hello(port_path="1-1.3"))


def test_a_serial_of_zeros_identifies_nothing() -> None:
    zeros = hello(serial="0000000000000000")
    assert known_serial(zeros) is None
    refusal(Roster((Slot(0, "front", serial="0000000000000000"),)), zeros)


def test_an_open_roster_takes_any_id_and_gives_the_lowest_free_one() -> None:
    roster = Roster((Slot(0, "front", serial="S0"),), open=True)
    assert roster.assign(hello(200), None, ()) == 200
    assert roster.assign(hello(), None, ()) == 1
    assert roster.assign(hello(), None, (1, 2)) == 3
    assert roster.assign(hello(serial="S0"), None, (1, 2)) == 0


def test_an_open_roster_gives_a_camera_the_id_that_it_had() -> None:
    assert Roster(open=True).assign(hello(), 7, (0, 1)) == 7
    assert Roster(open=True).assign(hello(3), 7, (0, 1)) == 3


def test_an_open_roster_is_bounded() -> None:
    assert "64 cameras" in refusal(Roster(open=True), hello(200), tuple(range(MAX_CAMERAS)))


def test_a_camera_is_described_by_all_it_states() -> None:
    camera = make_hello(name="cam03", camera_id=3, serial="S3", port_path="1-1")
    assert describe(camera) == "camera 'cam03' (id 3, serial S3, port 1-1)"
    assert describe(hello()) == "camera 'cam00' (no id, serial or port)"
