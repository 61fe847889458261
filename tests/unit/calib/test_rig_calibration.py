"""calibration.json keeps what it is given, reads files of older programs, and refuses what cannot be."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig_calib.depth_model import DepthCorrection
from rig_calib.rig_calibration import CalibratedEdge, RigCalibration
from rig_protocol.errors import DataError
from rig_protocol.poses import inverse
from support.box_room import calibration_of, ring_poses

POSES = ring_poses(3)


def full() -> RigCalibration:
    root = np.random.default_rng(0).normal(0, 1e-3, (3, 6, 6))
    covariances = root @ root.transpose(0, 2, 1)
    known = calibration_of(
        POSES,
        edges=(CalibratedEdge(0, 1, 9, 8, 1.0, inverse(POSES[0]) @ POSES[1], True, None, covariances[0]),),
    )
    camera = replace(
        known.cameras[1],
        covariance=covariances[1],
        aligned_covariance=covariances[2],
        depth_correction=DepthCorrection((0.01, -0.002)),
    )
    return replace(known, cameras=(known.cameras[0], camera, known.cameras[2]))


def older(values: dict[str, Any]) -> dict[str, Any]:
    """As a program wrote it that knew neither aligned nor relative covariances."""
    for camera in values["cameras"]:
        del camera["aligned_covariance"]
    for edge in values["edges"]:
        del edge["relative_covariance"]
    return values


def test_a_file_gives_back_bit_by_bit_what_was_saved(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    full().save(path)
    assert RigCalibration.load(path).to_dict() == full().to_dict()
    edge = RigCalibration.load(path).edges[0]
    assert edge.relative_covariance is not None
    np.testing.assert_array_equal(edge.relative_covariance, full().edges[0].relative_covariance)


def test_files_of_the_first_programs_are_read(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(older(full().to_dict())))
    known = RigCalibration.load(path)
    assert known.cameras[1].covariance is not None
    assert known.cameras[1].aligned_covariance is None
    assert known.edges[0].relative_covariance is None


@pytest.mark.parametrize(
    "covariance", [[[1.0] * 6] * 5, [[float("nan")] * 6] * 6, np.arange(36.0).reshape(6, 6).tolist(), "x", 3]
)
def test_what_cannot_be_a_covariance_is_refused(covariance: object) -> None:
    values = full().to_dict()
    values["edges"][0]["relative_covariance"] = covariance
    with pytest.raises(DataError, match="malformed calibration"):
        RigCalibration.from_dict(values)
