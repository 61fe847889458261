from rig_protocol.smoothed_delay import SmoothedDelay

MS = 1_000_000


def test_the_bound_is_the_initial_one_before_any_observation() -> None:
    assert SmoothedDelay(6 * MS, 2 * MS, 50 * MS).bound_ns == 6 * MS


def test_a_steady_delay_is_bounded_closely_and_a_wavering_one_widely() -> None:
    steady, wavering = SmoothedDelay(6 * MS, 0, 50 * MS), SmoothedDelay(6 * MS, 0, 50 * MS)
    for k in range(100):
        steady.add(4 * MS)
        wavering.add(4 * MS + (k % 2) * 2 * MS)
    assert 4 * MS <= steady.bound_ns < 4.1 * MS
    assert 7 * MS < wavering.bound_ns < 11 * MS


def test_the_bound_stays_within_its_limits() -> None:
    delay = SmoothedDelay(6 * MS, 2 * MS, 50 * MS)
    delay.add(1)
    assert delay.bound_ns == 2 * MS
    delay.add(10**12)
    assert delay.bound_ns == 50 * MS


def test_one_outlier_is_forgotten() -> None:
    delay = SmoothedDelay(6 * MS, 0, 500 * MS)
    for _ in range(50):
        delay.add(MS)
    delay.add(40 * MS)
    assert delay.bound_ns > 30 * MS
    for _ in range(50):
        delay.add(MS)
    assert delay.bound_ns < 2 * MS
