from rig_protocol.resend_budget import ResendBudget

SECOND_NS = 1_000_000_000


def test_without_a_limit_everything_may_be_asked_for() -> None:
    assert ResendBudget().grant(10_000, 1472, 0) == 10_000


def test_no_more_is_granted_than_the_spare_rate_and_what_was_saved_up() -> None:
    budget = ResendBudget()
    budget.limit(1_000_000)
    granted = sum(
        budget.grant(50, 1000, k * 10_000_000) for k in range(501)
    )  # 5 s, asking for five times as much
    assert 0.99 * 5_000 <= granted <= 5_000 + 100


def test_what_is_saved_up_is_a_tenth_of_a_second() -> None:
    budget = ResendBudget()
    budget.limit(1_000_000)
    budget.grant(0, 1000, 0)
    assert budget.grant(10_000, 1000, 60 * SECOND_NS) == 100


def test_a_whole_frame_is_granted_in_the_end_however_little_the_link_has_left() -> None:
    budget = ResendBudget()
    budget.limit(1_000_000)
    grants = [budget.grant(1, 1_500_000, k * 100_000_000) for k in range(40)]
    assert sum(grants) == 2


def test_a_clock_that_is_set_back_neither_grants_nor_blocks() -> None:
    budget = ResendBudget()
    budget.limit(1_000_000)
    budget.grant(1000, 1000, 3_600 * SECOND_NS)
    assert budget.grant(1000, 1000, 0) == 0
    assert budget.grant(1000, 1000, SECOND_NS) == 100
