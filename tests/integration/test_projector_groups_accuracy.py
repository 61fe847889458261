"""What projector groups are for: where neighbours' dots spoil depth, a grouped capture calibrates better."""

import pytest

from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.calibration import calibrate
from rig_calib.evaluation import evaluate
from rig_calib.settings import CalibrationSettings
from rig_calib.view import views_from_panoramas
from rig_protocol.frames import PanoramicFrame
from rig_server.projector_groups import assign_groups

CAMERAS = 4


def error_mm(settings: SimulatorSettings, groups: int) -> float:
    """Mean error of the distance between neighbours, calibrated on one set that was taken in groups."""
    rig, description = VirtualRig(settings), rig_description(settings)
    everybody = frozenset(range(CAMERAS))
    turns = [everybody] if groups == 1 else [*map(frozenset, assign_groups(description, groups))]
    frames = {i: rig.camera(i).frame(0, dark=everybody - turn) for turn in turns for i in turn}
    views = views_from_panoramas(description, [PanoramicFrame.of(0, frames)])
    result = calibrate(views, description.ring, CalibrationSettings(), lambda *_: None)
    summary = evaluate(result.calibration, true_poses(settings)).summaries()["neighbours"]
    return summary.mean.mm


@pytest.mark.parametrize("seed", [0, 1])
def test_a_grouped_capture_calibrates_twice_as_well_where_dots_spoil_depth(seed: int) -> None:
    spoiled = SimulatorSettings(cameras=CAMERAS, seed=seed, interference=0.25, interference_noise_lsb=2.0)
    together, in_groups = error_mm(spoiled, 1), error_mm(spoiled, 2)
    assert in_groups < together / 2, f"{together:.1f} mm together, {in_groups:.1f} mm in groups"
    undisturbed = spoiled.model_copy(update={"interference": 0.0, "interference_noise_lsb": 0.0})
    assert in_groups == pytest.approx(error_mm(undisturbed, 1), rel=1e-6)
