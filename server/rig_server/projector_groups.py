"""Which cameras of a ring may project at the same time without shining into each other's view."""

from itertools import combinations

import numpy as np

from rig_protocol.errors import ConfigurationError
from rig_protocol.rig_folder import RigDescription

Groups = tuple[tuple[int, ...], ...]

# A Kinect sees 43° across the ring, its projector reaches a little further, and mounting errs by a degree.
_OVERLAPPING_DEG = 44.5


def assign_groups(description: RigDescription, count: int) -> Groups:
    """Camera ids in at most `count` groups, no two of one group neighbours; as even as that allows.

    Neighbours are those whose nominal axes are less than 44.5° apart; where poses are unknown, those whose
    ids follow one another, around the ring. ConfigurationError where so few groups do not do.
    """
    neighbours = _neighbours(description)
    groups: list[list[int]] = [[] for _ in range(count)]
    for camera_id in description.camera_ids:
        free = [group for group in groups if not neighbours[camera_id].intersection(group)]
        if not free:
            raise ConfigurationError(
                f"{count} projector groups cannot keep the neighbours of this ring apart"
                + (": use 3" if count < 3 else "; calibrate without --projector-groups")
            )
        min(free, key=len).append(camera_id)
    return tuple(tuple(group) for group in groups if group)


def _neighbours(description: RigDescription) -> dict[int, set[int]]:
    ids = description.camera_ids
    pairs: list[tuple[int, int]] = []
    axes = {
        camera.id: camera.T_rig_camera[:3, 2]
        for camera in description.cameras
        if camera.T_rig_camera is not None
    }
    if len(axes) == len(ids):
        least_cosine = np.cos(np.deg2rad(_OVERLAPPING_DEG))
        pairs = [(i, j) for i, j in combinations(ids, 2) if axes[i] @ axes[j] > least_cosine]
    elif len(ids) > 1:
        pairs = list(zip(ids, (*ids[1:], ids[0]), strict=True))
    found: dict[int, set[int]] = {camera_id: set() for camera_id in ids}
    for i, j in pairs:
        found[i].add(j)
        found[j].add(i)
    return found
