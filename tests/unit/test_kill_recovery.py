"""The soak's verdict on recovery is a measuring instrument: what it must not overlook, and must not blame."""

from support.kill_recovery import DeliveredSet, Kill, camera_since, complete_since, unexplained, whole_since

KILL = Kill(camera=3, signal="SIGKILL", kill_s=10.0, restart_s=12.0, ready_s=12.5)


def sets(missing_until: dict[int, float], begin_s: float = 10.0) -> list[DeliveredSet]:
    """Ten a second for twenty seconds; each camera is away until its time."""
    times_s = [begin_s + i / 10 for i in range(200)]
    return [
        DeliveredSet(t, frozenset(camera for camera, until_s in missing_until.items() if t < until_s))
        for t in times_s
    ]


def test_the_first_whole_set_after_the_restart_counts_and_none_before_it() -> None:
    assert whole_since(KILL, [KILL], sets({3: 13.0})) == 13.0
    assert whole_since(KILL, [KILL], sets({})) == KILL.restart_s


def test_a_single_whole_set_among_others_is_no_recovery() -> None:
    delivered = sets({3: 14.0})
    delivered[25] = DeliveredSet(delivered[25].time_s, frozenset())
    assert whole_since(KILL, [KILL], delivered) == 14.0


def test_a_camera_that_another_kill_keeps_away_is_not_blamed_but_no_set_without_it_is_complete() -> None:
    other = Kill(camera=5, signal="SIGTERM", kill_s=10.0, restart_s=13.0, ready_s=13.5)
    delivered = sets({3: 13.0, 5: 15.0})
    assert whole_since(KILL, [KILL, other], delivered) == 13.0
    assert complete_since(KILL, delivered) == 15.0


def test_a_camera_away_without_a_reason_or_for_too_long_is_told() -> None:
    assert whole_since(KILL, [KILL], sets({3: 13.0, 7: 40.0})) is None
    assert camera_since(KILL, sets({3: 13.0, 7: 40.0})) == 13.0
    assert len(unexplained([KILL], sets({7: 11.05}))) == 11
    assert not unexplained([KILL], sets({3: 17.45}))
    assert len(unexplained([KILL], sets({3: 17.75}))) == 2
