"""Seeded runs of a whole rig in virtual time: drift, jitter, loss, cameras that come and go, wrong clocks."""

import dataclasses

import numpy as np
import pytest

from rig_protocol.synchroniser import Policy
from support.frame_streams import (
    DEADLINE_NS,
    MS,
    PERIOD_NS,
    Arrival,
    Delivery,
    Happening,
    S,
    check_sets,
    free_running,
    joined,
    run,
    stream,
)

CAMERAS = 12


def test_of_twelve_free_running_cameras_without_loss_999_of_1000_sets_are_complete() -> None:
    rng = np.random.default_rng(11)
    seconds = 60
    arrivals = [item for i in range(CAMERAS) for item in free_running(rng, i, seconds)]
    synchroniser = joined(range(CAMERAS))
    delivered = run(synchroniser, arrivals)
    used = check_sets(delivered)
    settled = delivered[5:-5]
    assert sum(d.panorama.complete for d in settled) >= 0.999 * len(settled)
    assert len(delivered) == pytest.approx(30 * seconds, abs=3)
    assert max(d.panorama.spread_ns for d in settled) < PERIOD_NS
    # A slip costs its camera one frame; the rest is start and end.
    assert len(used) >= len(arrivals) - 3 * CAMERAS


@pytest.mark.parametrize("drift_ppm", [1000, -1000])
def test_every_slip_of_a_drifting_camera_costs_one_frame_of_that_camera(drift_ppm: int) -> None:
    period_ns = round(PERIOD_NS * (1 - drift_ppm * 1e-6))
    arrivals = stream(0, 0, 5000) + stream(1, 8 * MS, 5000) + stream(2, 15 * MS, 5000, period_ns)
    synchroniser = joined(range(3))
    delivered = run(synchroniser, arrivals)[5:-10]
    slips = 5
    missing = [d.panorama.missing for d in delivered if not d.panorama.complete]
    assert synchroniser.counters.skipped <= slips + 2
    assert missing in ([], [(2,)] * len(missing))
    assert len(missing) <= slips + 1


@pytest.mark.parametrize("loss", [0.01, 0.2])
def test_lost_frames_are_missing_from_their_own_set_only(loss: float) -> None:
    rng = np.random.default_rng(5)
    arrivals = [item for i in range(CAMERAS) for item in free_running(rng, i, 20, loss=loss)]
    synchroniser = joined(range(CAMERAS))
    delivered = run(synchroniser, arrivals)
    used = check_sets(delivered)
    assert len(delivered) == pytest.approx(600, abs=8)
    assert len(used) >= 0.99 * len(arrivals)


@pytest.mark.parametrize("policy", ["partial", "strict"])
def test_a_camera_without_any_rhythm_keeps_no_sets_from_going_out(policy: Policy) -> None:
    rng = np.random.default_rng(2)
    arrivals = [item for i in range(3) for item in free_running(rng, i, 20)]
    arrivals += free_running(rng, 3, 20, jitter_ns=PERIOD_NS // 2 - MS)
    delivered = run(joined(range(4), policy=policy), arrivals)
    check_sets(delivered)
    assert sum(d.panorama.complete for d in delivered) > 300


def hard_life(seed: int) -> tuple[list[Arrival], list[Happening], int]:
    """Ten seconds of trouble, then ten of peace, and when peace begins."""
    rng = np.random.default_rng(seed)
    peace_ns = 10 * S
    arrivals: list[Arrival] = []
    happenings: list[Happening] = []
    for camera_id in range(6):
        troubled = free_running(rng, camera_id, 9, loss=0.05)
        joins_ns = int(rng.uniform(0, 2 * S))
        leaves_ns = int(rng.uniform(4 * S, 6 * S))
        returns_ns = leaves_ns + int(rng.uniform(0, 2 * S))
        steps_ns = int(rng.uniform(2 * S, 8 * S))
        hour_ns = int(rng.choice([-3600, 3600])) * S
        for now_ns, item in troubled:
            if joins_ns <= now_ns < leaves_ns or now_ns >= returns_ns:
                # The clock is wrong for a second, until the server has noticed.
                wrong_ns = hour_ns if steps_ns <= now_ns < steps_ns + S else 0
                stepped = dataclasses.replace(item, timestamp_ns=item.timestamp_ns + wrong_ns)
                arrivals.append((now_ns, stepped))
        happenings.append((joins_ns, lambda s, i=camera_id: s.camera_joined(i, 30.0)))
        happenings.append((leaves_ns, lambda s, i=camera_id: s.camera_left(i)))
        happenings.append((returns_ns, lambda s, i=camera_id: s.camera_joined(i, 30.0)))
        again = free_running(rng, camera_id, 10, start_ns=peace_ns)
        arrivals += [(now, dataclasses.replace(item, sequence=item.sequence + 10_000)) for now, item in again]
    return arrivals, happenings, peace_ns


@pytest.mark.parametrize("policy", ["partial", "strict", "latest"])
@pytest.mark.parametrize("seed", range(4))
def test_after_any_trouble_the_rig_is_whole_again_within_a_second(policy: Policy, seed: int) -> None:
    arrivals, happenings, peace_ns = hard_life(seed)
    synchroniser = joined([], policy=policy)
    delivered = run(synchroniser, arrivals, happenings)
    used = check_sets(delivered, repeats=policy == "latest")
    counters = synchroniser.counters
    assert len(used) + counters.late + counters.skipped + counters.implausible == len(arrivals)
    assert counters.late + counters.implausible > 50  # the clocks did step

    def between(start_ns: int, end_ns: int) -> list[Delivery]:
        return [d for d in delivered if peace_ns + start_ns <= d.panorama.timestamp_ns < peace_ns + end_ns]

    settled = between(S, 9 * S)
    assert len(settled) == pytest.approx(8 * 30, abs=2)
    assert sum(d.panorama.complete for d in settled) >= len(settled) - 1
    assert all(len(d.panorama.frames) == 6 for d in settled)
    assert max(d.now_ns - d.panorama.timestamp_ns for d in settled) < PERIOD_NS + DEADLINE_NS
