"""Rig.open on a recorded rig folder, and what it refuses."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, write_rig_folder
from rig_server import Rig
from rig_server.config import RigSettings

SETTINGS = RigSettings()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cameras; camera 1 lacks index 2."""
    rng = np.random.default_rng(0)
    cameras = tuple(CameraEntry(i, f"cam{i:02d}", CameraModel()) for i in range(2))
    frames = [
        RgbdFrame(
            camera_id=i,
            sequence=k,
            timestamp_ns=0,
            color=rng.integers(0, 255, (4, 6, 3), dtype=np.uint8),
            raw=rng.integers(0, 2047, (4, 6), dtype=np.uint16),
        )
        for i, k in [(0, 0), (1, 0), (0, 1), (1, 1), (0, 2)]
    ]
    write_rig_folder(tmp_path, RigDescription(cameras), frames)
    return tmp_path


def test_a_recorded_rig_is_read_as_panoramic_frames_once(folder: Path) -> None:
    with Rig.open(folder, SETTINGS) as rig:
        panoramas = list(rig)
        status = rig.status()
    assert [panorama.index for panorama in panoramas] == [0, 1, 2]
    assert [panorama.missing for panorama in panoramas] == [(), (), (1,)]
    assert panoramas[0].spread_ns == 0
    frame = panoramas[1].frames[1]
    assert frame is not None
    assert frame.raw is not None
    assert frame.sequence == 1
    assert (status.complete, status.partial) == (2, 1)


def test_a_recorded_rig_is_whole_and_describes_itself(folder: Path) -> None:
    with Rig.open(str(folder), SETTINGS) as rig:
        rig.wait_for_cameras(timeout_s=0.0)
        assert rig.description.camera_ids == (0, 1)
        assert rig.source == "folder"
        assert rig.true_poses() is None


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("no/such/folder", "no/such/folder is no folder"),
        ("simulated:many", "write simulated:N"),
        ("simulated:0", "write simulated:N"),
        ("udp://127.0.0.1:port", "port from 0 to 65535"),
    ],
)
def test_a_source_that_makes_no_sense_is_a_configuration_error(source: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        Rig.open(source, SETTINGS)


def test_a_folder_without_frames_is_a_configuration_error(tmp_path: Path) -> None:
    (tmp_path / "cam00").mkdir()
    write_rig_folder(tmp_path, RigDescription((CameraEntry(0, "cam00", CameraModel()),)), [])
    with pytest.raises(ConfigurationError, match="holds no frames"):
        Rig.open(tmp_path, SETTINGS)


def test_simulated_agents_are_ended_even_when_somebody_loses_patience_with_the_server() -> None:
    feed, simulation = Mock(), Mock()
    feed.stop.side_effect = KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), Rig(feed, SETTINGS, simulation):
        pass
    simulation.close.assert_called_once()
