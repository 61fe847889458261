"""Which losses are taken for overload."""

from collections.abc import Sequence

from rig_server.loss_watch import LossWatch

BIN_NS = 500_000_000
CAMERAS = range(12)


class Counts:
    """Twelve cameras at 30 frames/s whose counts grow bin by bin."""

    def __init__(self) -> None:
        self.watch = LossWatch()
        self.received = dict.fromkeys(CAMERAS, 0)
        self.lost = dict.fromkeys(CAMERAS, 0)
        self.now_ns = 0
        self.watch.update(self.received, self.lost, 0)

    def bins(self, lost: Sequence[int], of: Sequence[int] = CAMERAS) -> bool:
        """One bin for each number of frames that each camera loses of its 15."""
        for count in lost:
            self.now_ns += BIN_NS
            for camera in CAMERAS:
                gone = count if camera in of else 0
                self.lost[camera] += gone
                self.received[camera] += 15 - min(gone, 15)
            self.watch.update(self.received, self.lost, self.now_ns)
        return self.watch.overloaded


def test_losses_of_most_cameras_that_last_a_second_are_overload() -> None:
    assert not Counts().bins([0, 0, 0])
    assert not Counts().bins([0, 3])
    assert Counts().bins([0, 3, 3])


def test_an_outage_that_is_over_is_none() -> None:
    assert not Counts().bins([0, 90, 0, 0])


def test_one_bad_cable_is_none() -> None:
    assert not Counts().bins([9, 9, 9, 9], of=[3])


def test_losses_that_less_load_does_not_lessen_have_another_cause() -> None:
    counts = Counts()
    assert counts.bins([3, 3])
    counts.watch.answered()
    assert not counts.bins([3, 3, 3])
    counts.bins([0, 0])
    assert counts.bins([3, 3]), "after they had ended, new ones are looked at anew"


def test_losses_that_less_load_lessens_are_answered_again() -> None:
    counts = Counts()
    assert counts.bins([6, 6])
    counts.watch.answered()
    assert counts.bins([3, 3])


def test_a_link_that_is_several_times_too_small_loses_as_many_as_before() -> None:
    counts = Counts()
    assert counts.bins([15, 15])
    counts.watch.answered()
    assert counts.bins([15, 15])


def test_a_count_that_began_anew_is_no_loss() -> None:
    counts = Counts()
    counts.bins([3])
    counts.received, counts.lost = dict.fromkeys(CAMERAS, 0), dict.fromkeys(CAMERAS, 0)
    assert not counts.bins([0, 0])
