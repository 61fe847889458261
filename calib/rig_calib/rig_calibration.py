"""RigCalibration: the result of a calibration, and its file `calibration.json` (schema 1 of formats.md)."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection
from rig_calib.uncertainty import PoseCovariance
from rig_calib.whole_file import whole_file
from rig_protocol.camera import as_pose
from rig_protocol.errors import DataError
from rig_protocol.poses import Pose, inverse
from rig_protocol.rig_folder import read_json

SCHEMA = 1


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """Pose of one colour camera: T_true = T_rig_camera · Exp(δ), δ ~ N(0, covariance), rotation first.

    `aligned_covariance` is that of δ without the common turn and shift of the whole rig against its frame.
    """

    id: int
    name: str
    T_rig_camera: Pose
    covariance: npt.NDArray[np.float64] | None = None
    depth_correction: DepthCorrection | None = None
    serial: str | None = None
    aligned_covariance: npt.NDArray[np.float64] | None = None

    def to_dict(self) -> dict[str, Any]:
        """One item of `cameras`."""
        return {
            "id": self.id,
            "name": self.name,
            "serial": self.serial,
            "T_rig_camera": self.T_rig_camera.tolist(),
            "covariance": _listed(self.covariance),
            "aligned_covariance": _listed(self.aligned_covariance),
            "depth_correction": None if self.depth_correction is None else self.depth_correction.to_dict(),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "CalibratedCamera":
        """Read one item of `cameras`."""
        correction = values.get("depth_correction")
        return cls(
            id=int(values["id"]),
            name=str(values["name"]),
            T_rig_camera=as_pose(values["T_rig_camera"], "T_rig_camera"),
            covariance=_as_covariance(values.get("covariance")),
            depth_correction=None if correction is None else DepthCorrection.from_dict(correction),
            serial=values.get("serial"),
            aligned_covariance=_as_covariance(values.get("aligned_covariance")),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedEdge:
    """One pair of cameras with a common view; `T_i_j` is what this edge alone measured.

    `relative_covariance` (6,6) is of the calibration's own inverse(T_rig_i) · T_rig_j, on its right.
    """

    i: int
    j: int
    matches: int
    inliers: int
    rms_mm: float
    T_i_j: Pose
    used: bool
    reason: str | None = None
    relative_covariance: npt.NDArray[np.float64] | None = None

    def to_dict(self) -> dict[str, Any]:
        """One item of `edges`."""
        return {
            "i": self.i,
            "j": self.j,
            "matches": self.matches,
            "inliers": self.inliers,
            "rms_mm": self.rms_mm,
            "T_i_j": self.T_i_j.tolist(),
            "used": self.used,
            "reason": self.reason,
            "relative_covariance": _listed(self.relative_covariance),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "CalibratedEdge":
        """Read one item of `edges`."""
        return cls(
            int(values["i"]),
            int(values["j"]),
            int(values["matches"]),
            int(values["inliers"]),
            float(values["rms_mm"]),
            as_pose(values["T_i_j"], "T_i_j"),
            bool(values["used"]),
            values.get("reason"),
            _as_covariance(values.get("relative_covariance")),
        )


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """By how much the ring of edges fails to close, before and after the optimisation."""

    before_deg: float
    before_mm: float
    after_deg: float
    after_mm: float

    def to_dict(self) -> dict[str, Any]:
        """The `loop_closure` object."""
        return {
            "before": {"rotation_deg": self.before_deg, "translation_mm": self.before_mm},
            "after": {"rotation_deg": self.after_deg, "translation_mm": self.after_mm},
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "LoopClosure":
        """Read the `loop_closure` object."""
        before, after = values["before"], values["after"]
        return cls(
            float(before["rotation_deg"]),
            float(before["translation_mm"]),
            float(after["rotation_deg"]),
            float(after["translation_mm"]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """Where every colour camera of the rig is, how well that is known, and from what it was found.

    `joint_covariance` (6N,6N) is that of all N poses, in the order of `cameras`: the covariance of every pair
    follows from it. `failures` are the reasons why the result does not pass its own gate; empty means it
    passes.
    """

    method: str
    rig_frame: str
    cameras: tuple[CalibratedCamera, ...]
    edges: tuple[CalibratedEdge, ...]
    loop_closure: LoopClosure | None
    seconds: Mapping[str, float]
    frames_used: int
    created: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()
    joint_covariance: npt.NDArray[np.float64] | None = None

    @property
    def poses(self) -> dict[int, Pose]:
        """T_rig_camera by camera id, of every camera that could be placed."""
        return {camera.id: camera.T_rig_camera for camera in self.cameras}

    def camera(self, camera_id: int) -> CalibratedCamera | None:
        """The camera with this id, or None when the calibration could not place it."""
        return next((camera for camera in self.cameras if camera.id == camera_id), None)

    def relative_covariance(self, i: int, j: int) -> npt.NDArray[np.float64] | None:
        """Covariance (6,6) of T_i_j, on its right; None without a pose, or when the method gives none."""
        order = [camera.id for camera in self.cameras]
        if self.joint_covariance is None or i not in order or j not in order:
            return None
        blocks = PoseCovariance(self.joint_covariance.reshape(len(order), 6, len(order), 6))
        T_i_j = inverse(self.poses[i]) @ self.poses[j]
        return blocks.relative(order.index(i), order.index(j), T_i_j)

    def to_dict(self) -> dict[str, Any]:
        """The `calibration.json` form."""
        return {
            "schema": SCHEMA,
            "created": self.created,
            "method": self.method,
            "rig_frame": self.rig_frame,
            "provenance": dict(self.provenance),
            "cameras": [camera.to_dict() for camera in self.cameras],
            "edges": [edge.to_dict() for edge in self.edges],
            "loop_closure": None if self.loop_closure is None else self.loop_closure.to_dict(),
            "seconds": dict(self.seconds),
            "frames_used": self.frames_used,
            "warnings": list(self.warnings),
            "failures": list(self.failures),
            "joint_covariance": _listed(self.joint_covariance),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RigCalibration":
        """Read the `calibration.json` form; DataError when it is malformed or of another schema."""
        if not isinstance(values, Mapping) or values.get("schema") != SCHEMA:
            raise DataError(f"not a calibration of schema {SCHEMA}; make a new one with `rig-calib solve`")
        try:
            loop = values.get("loop_closure")
            cameras = tuple(map(CalibratedCamera.from_dict, values["cameras"]))
            return cls(
                method=str(values["method"]),
                rig_frame=str(values["rig_frame"]),
                cameras=cameras,
                edges=tuple(map(CalibratedEdge.from_dict, values["edges"])),
                loop_closure=None if loop is None else LoopClosure.from_dict(loop),
                seconds={str(key): float(value) for key, value in values["seconds"].items()},
                frames_used=int(values["frames_used"]),
                created=str(values.get("created", "")),
                provenance=dict(values.get("provenance", {})),
                warnings=tuple(map(str, values.get("warnings", ()))),
                failures=tuple(map(str, values.get("failures", ()))),
                joint_covariance=_as_covariance(values.get("joint_covariance"), 6 * len(cameras)),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"malformed calibration: {error!r}") from error

    def save(self, path: Path) -> None:
        """Write the file whole or not at all."""
        with whole_file(path) as file:
            file.write(json.dumps(self.to_dict(), indent=1).encode() + b"\n")

    @classmethod
    def load(cls, path: Path) -> "RigCalibration":
        """Read a `calibration.json`; ConfigurationError when absent, DataError when malformed."""
        values = read_json(path)
        try:
            return cls.from_dict(values)
        except DataError as error:
            raise DataError(f"{path}: {error}") from error


def _listed(covariance: npt.NDArray[np.float64] | None) -> list[list[float]] | None:
    return None if covariance is None else covariance.tolist()


def _as_covariance(values: Any, size: int = 6) -> npt.NDArray[np.float64] | None:
    """A covariance (size,size) from its list, None of None; ValueError when it cannot be one."""
    if values is None:
        return None
    covariance = np.array(values, dtype=np.float64).reshape(size, size)
    if not np.isfinite(covariance).all() or not np.allclose(covariance, covariance.T):
        raise ValueError(f"a covariance is a finite, symmetric {size}x{size} matrix")
    return covariance
