"""Kalibr's camera chain (camchain.yaml): each camera relative to the one before it.

https://github.com/ethz-asl/kalibr/wiki/yaml-formats. `T_cn_cnm1` maps points from camera n−1 to camera n;
axes and pixel centres are OpenCV's. The chain keeps relative poses only: its origin is the first camera.
"""

from typing import Any

import numpy as np
import yaml

from rig_calib.exports.exported_rig import Export, ExportedCamera, ExportedRig
from rig_protocol.camera import Intrinsics, as_pose
from rig_protocol.errors import DataError
from rig_protocol.poses import inverse

FILE = "camchain.yaml"

Radtan = tuple[float, float, float, float]

_RADII = 200
_WORTH_TELLING_PX = 0.01


def export(rig: ExportedRig) -> Export:
    """The chain in the order of the rig's cameras, with topics after their names."""
    chain, notes = {}, []
    for n, (camera, color) in enumerate(zip(rig.cameras, rig.colors(), strict=True)):
        coefficients, error_px = _radtan(color)
        if error_px > _WORTH_TELLING_PX:
            notes.append(
                f"{camera.name}: radtan has no k3; k1 and k2 stand in for it, {error_px:.2f} px off at worst"
            )
        chain[f"cam{n}"] = _camera(rig, n, color, coefficients)
    text = yaml.safe_dump(chain, default_flow_style=None, sort_keys=False, width=1000)
    return Export({FILE: text}, notes)


def read_camchain(text: str) -> ExportedRig:
    """Cameras of a chain, posed in the frame of the first; DataError when it is none.

    Names are those of the topics, as `export` writes them.
    """
    try:
        chain = yaml.safe_load(text)
        cameras: list[ExportedCamera] = []
        overlaps = set()
        T = np.eye(4)
        for n in range(len(chain)):
            values = chain[f"cam{n}"]
            if n:
                T = T @ inverse(as_pose(values["T_cn_cnm1"], "T_cn_cnm1"))
            cameras.append(ExportedCamera(str(values["rostopic"]).split("/")[1], T, _intrinsics(values)))
            overlaps |= {(min(n, int(m)), max(n, int(m))) for m in values["cam_overlaps"]}
    except (yaml.YAMLError, IndexError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"not a camera chain of Kalibr: {error!r}") from error
    if not cameras:
        raise DataError("not a camera chain of Kalibr: it holds no camera")
    return ExportedRig(tuple(cameras), tuple(sorted(overlaps)))


def _camera(rig: ExportedRig, n: int, color: Intrinsics, coefficients: Radtan) -> dict[str, Any]:
    shared = {m for pair in rig.overlaps if n in pair for m in pair} - {n}
    values: dict[str, Any] = {}
    if n:
        T = inverse(rig.cameras[n].T_rig_camera) @ rig.cameras[n - 1].T_rig_camera
        values["T_cn_cnm1"] = T.tolist()
    return values | {
        "cam_overlaps": sorted(shared),
        "camera_model": "pinhole",
        "distortion_coeffs": [float(value) for value in coefficients],
        "distortion_model": "radtan",
        "intrinsics": [float(value) for value in (color.fx, color.fy, color.cx, color.cy)],
        "resolution": [color.width, color.height],
        "rostopic": f"/{rig.ros_names()[n]}/color/image_raw",
    }


def _intrinsics(values: dict[str, Any]) -> Intrinsics:
    if (values["camera_model"], values["distortion_model"]) != ("pinhole", "radtan"):
        raise DataError(
            f"camera model {values['camera_model']}-{values['distortion_model']} is not pinhole-radtan"
        )
    fx, fy, cx, cy = values["intrinsics"]
    width, height = values["resolution"]
    k1, k2, p1, p2 = values["distortion_coeffs"]
    return Intrinsics(fx, fy, cx, cy, width, height, (k1, k2, p1, p2, 0.0))


def _radtan(color: Intrinsics) -> tuple[Radtan, float]:
    """(k1, k2, p1, p2) without k3, and by how many pixels they differ from the whole model at worst.

    k3 · r⁷ is fitted by least squares over the image's area with terms in r³ and r⁵.
    """
    k1, k2, p1, p2, k3 = color.dist
    reach_x = max(color.cx, color.width - 1 - color.cx) / color.fx
    reach_y = max(color.cy, color.height - 1 - color.cy) / color.fy
    r = np.linspace(0.0, np.hypot(reach_x, reach_y), _RADII)
    terms, wanted, weight = np.column_stack([r**3, r**5]), k3 * r**7, np.sqrt(r)
    added = np.linalg.lstsq(terms * weight[:, None], wanted * weight)[0]
    error_px = max(color.fx, color.fy) * float(np.abs(terms @ added - wanted).max())
    return (k1 + float(added[0]), k2 + float(added[1]), p1, p2), error_px
