"""Cameras of long ago: what a feed from the disk answers to whoever wants something of them."""

from collections.abc import Collection, Mapping

from rig_protocol.errors import RigError
from rig_protocol.events import ControlAnswered
from rig_protocol.messages import ControlValue
from rig_protocol.roster import Slot


class Unattended:
    """Part of a feed whose cameras cannot be told anything; it has a `place`."""

    @property
    def place(self) -> str:
        """Where the frames come from, in words."""
        raise NotImplementedError

    def control(
        self,
        cameras: int | Collection[int] | None,  # noqa: ARG002  # as every feed has it
        name: str,
        value: ControlValue,  # noqa: ARG002
    ) -> Mapping[int, ControlAnswered]:
        """Nobody is there: RigError."""
        raise RigError(f"{self.place} is no live rig: nobody is there to set {name}")

    def assign(self, slot: Slot) -> None:
        """A recording's cameras are what they are: RigError."""
        raise RigError(f"{self.place} is no live rig: slot {slot.camera_id} cannot be given away")
