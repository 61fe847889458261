"""What every consumer of panoramic frames offers."""

from typing import Protocol

from rig_protocol.frames import PanoramicFrame


class Sink(Protocol):
    """Where panoramic frames end. The program hands them over one by one, in order."""

    def take(self, panorama: PanoramicFrame) -> bool:
        """Take the next set; False when the sink wants no more."""
        ...
