"""Views of the simulated ring, rendered once: what a study runs on again and again."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import rig_agent.simulator
from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RingDrawing
from support.benchmark_record import REPOSITORY

CACHE = REPOSITORY / "build" / "cache"


@dataclass(frozen=True, slots=True, eq=False)
class RenderedRig:
    """The views that a calibration is given, the drawing, and the truth that it is not given."""

    settings: SimulatorSettings
    views: tuple[CameraView, ...]
    ring: RingDrawing
    truth: Mapping[int, Pose]
    folder: Path
    """Where what was computed of this rig is kept."""

    @property
    def frames(self) -> int:
        """How many frames the views hold."""
        return len(self.views[0].color)

    @property
    def nominal(self) -> dict[int, Pose]:
        """Where the drawing has the cameras."""
        return {v.camera_id: v.T_rig_nominal for v in self.views if v.T_rig_nominal is not None}


def rendered_rig(settings: SimulatorSettings, frames: int) -> RenderedRig:
    """The first frames of a simulated rig, from the cache when they were asked for before.

    Frames are kept one file each, under a name that changes with the settings and the simulator's code.
    """
    simulator = Path(rig_agent.simulator.__path__[0]).glob("*.py")
    folder = CACHE / f"room_{settings.seed:03d}_{code_hash(simulator, settings.model_dump_json())}"
    description = rig_description(settings)
    if description.ring is None:
        raise ValueError("the simulator draws a ring")
    rig = VirtualRig(settings)
    panoramas = [_panorama(rig, folder / f"{k:03d}.npz", k) for k in range(frames)]
    views = views_from_panoramas(description, panoramas)
    return RenderedRig(settings, tuple(views), description.ring, true_poses(settings), folder)


def _panorama(rig: VirtualRig, path: Path, k: int) -> PanoramicFrame:
    ids = range(rig.settings.cameras)
    if not path.exists():
        _store(path, {i: rig.camera(i).frame(k) for i in ids})
    with np.load(path) as stored:
        images = {i: {"bayer": stored[f"bayer_{i}"], "raw": stored.get(f"raw_{i}")} for i in ids}
    frames = {i: RgbdFrame(i, k, 0, gravity=rig.camera(i).gravity(k), **images[i]) for i in ids}
    return PanoramicFrame.of(k, frames)


def _store(path: Path, frames: Mapping[int, RgbdFrame]) -> None:
    images = {f"bayer_{i}": frame.bayer for i, frame in frames.items()}
    images |= {f"raw_{i}": frame.raw for i, frame in frames.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_suffix(".part.npz")  # two processes may render the same room
    np.savez_compressed(whole, **{name: image for name, image in images.items() if image is not None})
    whole.replace(path)


def code_hash(modules: Iterable[Path], *more: str) -> str:
    """A name for what some code makes of something."""
    digest = hashlib.sha256("".join(more).encode())
    for module in sorted(modules):
        digest.update(module.read_bytes())
    return digest.hexdigest()[:16]
