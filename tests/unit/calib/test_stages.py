"""Progress of a calibration."""

import numba

from rig_calib.stages import Stages


def test_a_stage_that_waits_for_the_compiler_says_so_and_goes_on() -> None:
    told: list[tuple[str, float]] = []
    stages = Stages(lambda stage, share: told.append((stage, share)))
    inner = numba.njit(lambda x: x + 1)
    outer = numba.njit(lambda x: 2 * inner(x))
    with stages.stage("features"):
        stages.tell(0.5)
        assert outer(1) == 4
    assert told[0] == ("features", 0.0)
    assert ("compiling, first run only", 0.2) in told
    after = told[told.index(("compiling, first run only", 0.2)) :]
    assert after[-1][0] == "features"
    assert [stage for stage, _ in after].count("features") == 2  # once when compiled, once at the end


def test_what_is_compiled_outside_a_stage_is_not_told() -> None:
    told: list[str] = []
    stages = Stages(lambda stage, _share: told.append(stage))
    with stages.stage("matching"):
        pass
    numba.njit(lambda x: x - 1)(2)
    assert set(told) == {"matching"}
