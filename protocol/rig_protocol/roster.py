"""Who belongs to the rig: which slot a camera that says hello may have (protocol/SPEC.md, section 6)."""

from collections.abc import Collection
from dataclasses import dataclass, replace

from rig_protocol.messages import Hello, Reject, RejectReason

# Five times the rig; bounds what strangers can make an open roster hold.
MAX_CAMERAS = 64
_MAX_ID = 255


@dataclass(frozen=True, slots=True)
class Slot:
    """A place in the rig; a serial or a port path binds it to one camera."""

    camera_id: int
    name: str
    serial: str | None = None
    port_path: str | None = None


@dataclass(frozen=True, slots=True)
class Roster:
    """The slots of a rig. An open one also takes cameras that it does not list."""

    slots: tuple[Slot, ...] = ()
    open: bool = False

    def with_slot(self, slot: Slot) -> "Roster":
        """The same with this slot in place of the one with its id, and its camera in no other."""
        others = (
            replace(one, serial=None) if slot.serial is not None and one.serial == slot.serial else one
            for one in self.slots
            if one.camera_id != slot.camera_id
        )
        slots = sorted([*others, slot], key=lambda one: one.camera_id)
        return Roster(tuple(slots), self.open)

    def assign(self, hello: Hello, recalled: int | None, taken: Collection[int]) -> int | Reject:
        """The camera id that a hello gets, or why none.

        `recalled` is the id that this very camera had before, `taken` those that other live cameras hold.
        """
        slot = self._slot_of(hello)
        if isinstance(slot, Slot):
            return _contradiction(slot, hello) or slot.camera_id
        if slot is not None:
            return slot
        if not self.open:
            return unknown_camera(f"{describe(hello)} is not in the rig: add it to the server's settings")
        if len(taken) >= MAX_CAMERAS:
            return unknown_camera(f"{MAX_CAMERAS} cameras are connected, more cannot be")
        if hello.camera_id is not None:
            return hello.camera_id
        if recalled is not None:
            return recalled
        listed = {slot.camera_id for slot in self.slots}
        return next(i for i in range(_MAX_ID + 1) if i not in listed and i not in taken)

    def _slot_of(self, hello: Hello) -> Slot | Reject | None:
        """The listed slot that a hello names; None where no slot fits."""
        if hello.camera_id is not None:
            return next((slot for slot in self.slots if slot.camera_id == hello.camera_id), None)
        serial = known_serial(hello)
        for slot in self.slots:
            if serial is not None and slot.serial == serial:
                return slot
        at_port = [slot for slot in self.slots if slot.port_path and _is_at(hello.port_path, slot.port_path)]
        if len(at_port) > 1:
            return unknown_camera(
                f"port path {hello.port_path} is that of {len(at_port)} slots: {describe(hello)} needs an id"
            )
        return at_port[0] if at_port else None


def known_serial(hello: Hello) -> str | None:
    """The serial where it identifies a camera: K4W units report only zeros."""
    return hello.serial if hello.serial and hello.serial.strip("0") else None


def describe(hello: Hello) -> str:
    """One camera in the operator's words."""
    serial = known_serial(hello)
    traits = [
        None if hello.camera_id is None else f"id {hello.camera_id}",
        None if serial is None else f"serial {serial}",
        None if hello.port_path is None else f"port {hello.port_path}",
    ]
    stated = ", ".join(trait for trait in traits if trait)
    return f"camera {hello.name!r} ({stated or 'no id, serial or port'})"


def unknown_camera(text: str) -> Reject:
    """The answer to a camera that has no place here."""
    return Reject(RejectReason.UNKNOWN_CAMERA, text)


def _contradiction(slot: Slot, hello: Hello) -> Reject | None:
    """A slot bound to one camera refuses another one."""
    expected = (
        ("serial", slot.serial, known_serial(hello) == slot.serial),
        ("port path", slot.port_path, _is_at(hello.port_path, slot.port_path or "")),
    )
    for trait, wanted, holds in expected:
        if wanted is not None and not holds:
            return unknown_camera(
                f"slot {slot.camera_id} ({slot.name}) is for {trait} {wanted}, {describe(hello)} is another"
            )
    return None


def _is_at(port_path: str | None, wanted: str) -> bool:
    """True at that port or behind it: a Kinect's camera (1-2.1) sits behind the hub of its cable (1-2)."""
    return port_path is not None and (port_path == wanted or port_path.startswith(f"{wanted}."))
