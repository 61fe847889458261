"""What comes out of offline work does not depend on how many processes do it, nor on one that dies."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest
from distributed import LocalCluster

from rig_calib.offline import dask_workers, worker_check
from rig_calib.offline.capture import Capture, open_capture
from rig_calib.offline.workers import Batch, ThisProcess, Workers, batches_of, open_workers
from rig_protocol.errors import ConfigurationError, DataError, RigError
from support import batch_work
from support.small_take import entries, write_take

SETS, BATCH = 20, 2


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A take of twenty sets."""
    return open_capture(write_take(tmp_path_factory.mktemp("take") / "take.mcap", entries(SETS)))


@pytest.fixture(scope="module")
def batches(capture: Capture) -> list[Batch]:
    """All of it, in ten batches."""
    return batches_of(capture, range(SETS), BATCH)


@pytest.fixture(scope="module")
def two() -> Iterator[Workers]:
    """Two processes, which all tests share."""
    with open_workers(2) as workers:
        yield workers


@pytest.fixture(scope="module")
def three() -> Iterator[Workers]:
    """Three processes; a batch whose worker dies is given up at once."""
    settings = {**dask_workers.LOCAL_SETTINGS, "distributed.scheduler.allowed-failures": 0}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(dask_workers, "LOCAL_SETTINGS", settings)
        with open_workers(3) as workers:
            yield workers


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of somebody's scheduler, with one worker."""
    monkeypatch.setattr(worker_check, "WAIT_S", 0.2)
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as started:
        yield started.scheduler_address


def test_batches_cover_every_position_once(capture: Capture) -> None:
    batches = batches_of(capture, range(3, SETS, 2), 4)
    assert [list(batch.positions) for batch in batches] == [[3, 5, 7, 9], [11, 13, 15, 17], [19]]


def test_two_processes_give_what_one_gives(two: Workers, batches: list[Batch]) -> None:
    shares: list[float] = []
    alone = list(ThisProcess().map(batch_work.digest, batches))
    assert list(two.map(batch_work.digest, batches, shares.append)) == alone
    assert len(set(alone)) == len(batches)
    assert shares == pytest.approx([(k + 1) / len(batches) for k in range(len(batches))])


def test_three_processes_give_what_one_gives(three: Workers, batches: list[Batch], tmp_path: Path) -> None:
    environment = dict(os.environ)
    at_work = set(three.map(partial(batch_work.everybody_works, tmp_path, 3), batches[:6]))
    assert len(at_work) == 3
    assert os.getpid() not in at_work
    assert os.environ == environment
    alone = list(ThisProcess().map(batch_work.digest, batches))
    assert list(three.map(batch_work.digest, batches)) == alone


def test_a_worker_that_is_killed_changes_nothing(two: Workers, batches: list[Batch], tmp_path: Path) -> None:
    marker = tmp_path / "killed"
    given = list(two.map(partial(batch_work.digest_killed_once, marker), batches))
    assert marker.exists()
    assert given == list(ThisProcess().map(batch_work.digest, batches))


def test_an_error_of_the_work_is_raised_as_it_is(two: Workers, batches: list[Batch]) -> None:
    results = two.map(batch_work.refused, batches)
    assert next(results) == 0
    with pytest.raises(DataError, match=r"^position 2 is wrong: look at it$"):
        next(results)


def test_a_batch_that_no_worker_survives_is_given_up_in_words(three: Workers, batches: list[Batch]) -> None:
    with pytest.raises(RigError, match=r"take.mcap: workers died 1 times while frames 0 to 3 .*memory"):
        list(three.map(batch_work.always_killed, batches[:2]))


def test_no_worker_runs_far_ahead_of_who_takes_the_results(
    two: Workers, capture: Capture, tmp_path: Path
) -> None:
    """Two batches a worker."""
    results = two.map(partial(batch_work.touched, tmp_path), batches_of(capture, range(SETS), 1))
    assert [next(results), next(results)] == [0, 1]
    list(two.map(batch_work.digest, batches_of(capture, range(4), 1)))  # time for whatever was sent
    assert len(list(tmp_path.iterdir())) <= 2 + 4
    assert list(results) == list(range(2, SETS))


def test_workers_keep_to_one_thread_each(two: Workers, batches: list[Batch]) -> None:
    assert set(two.map(batch_work.thread_counts, batches)) == {(1, "1")}


def test_the_processes_of_this_machine_listen_to_nobody_else(two: Workers, batches: list[Batch]) -> None:
    """Whoever speaks to a worker makes it run code: only this machine, and only with our keys."""
    list(two.map(batch_work.thread_counts, batches))
    parents = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    own = {line for pid in parents for line in listening(int(pid))} | set(listening(os.getpid()))
    assert own
    assert {address for address, _ in own} == {"0100007F"}


def listening(pid: int) -> list[tuple[str, str]]:
    """Addresses and ports (hexadecimal) that a process listens on."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        try:
            inodes.add(str(descriptor.readlink()).removeprefix("socket:[").removesuffix("]"))
        except OSError:  # it was closed meanwhile
            continue
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]
    ]
    return [tuple(line[1].split(":")) for line in lines if line[3] == "0A" and line[9] in inodes]  # type: ignore[misc]


def test_one_batch_starts_no_process(batches: list[Batch]) -> None:
    with open_workers(2) as workers:
        assert list(workers.map(batch_work.process, batches[:1])) == [os.getpid()]


@pytest.mark.parametrize("at_work", [0, 2])
def test_ctrl_c_ends_all_processes_without_a_traceback(
    capture: Capture, tmp_path: Path, at_work: int
) -> None:
    """While they start, or work. A terminal sends it to all of them at once."""
    begun = tmp_path / "begun"
    begun.mkdir()
    program = subprocess.Popen(
        [sys.executable, batch_work.__file__, str(capture.path), str(begun)],
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    while len(alive(program.pid)) < 4 or len(list(begun.iterdir())) < at_work:  # 4: with Python's own tracker
        assert program.poll() is None
        time.sleep(0.02)
    os.killpg(program.pid, signal.SIGINT)
    told = program.communicate(timeout=100)[1]
    assert told.count("Traceback") == told.count("KeyboardInterrupt") == 1, told  # of our own main
    while alive(program.pid):  # the tracker sees its pipe closed, and goes
        time.sleep(0.05)


def alive(group: int) -> list[int]:
    """The processes of a group that run."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, own = status.read_text().rsplit(")", 1)[1].split()[:3]
        except OSError:  # it ended meanwhile
            continue
        if int(own) == group and state != "Z":
            found.append(int(status.parent.name))
    return found


def test_a_cluster_gives_what_this_process_gives(cluster: str, batches: list[Batch]) -> None:
    with open_workers(scheduler=cluster) as workers:
        assert list(workers.map(batch_work.digest, batches)) == list(
            ThisProcess().map(batch_work.digest, batches)
        )


def test_a_worker_without_the_capture_is_named(cluster: str, tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.mcap", entries(4))
    batches = batches_of(open_capture(path), range(4), 2)
    path.unlink()
    with (
        open_workers(scheduler=cluster) as workers,
        pytest.raises(ConfigurationError, match=r"worker tcp://127\S+ does not see .*take.mcap"),
    ):
        list(workers.map(batch_work.digest, batches))
    assert not path.exists()


def test_what_a_worker_may_lack_is_told_in_words() -> None:
    own = (version("kinect-rig"), {"/data/take.mcap": 7})
    assert worker_check.lack(own, own) is None
    assert "has no kinect-rig" in str(worker_check.lack((None, {}), own))
    assert "has release 0.0.1" in str(worker_check.lack(("0.0.1", {}), own))
    assert "sees another /data" in str(worker_check.lack((own[0], {"/data/take.mcap": 8}), own))


def test_nobody_at_the_address_is_told_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig_calib.offline.dask_workers.CONNECT_S", 0.2)
    for address in ("tcp://127.0.0.1:9", "nonsense://", "127.0.0.1:port"):
        with (
            pytest.raises(ConfigurationError, match="no Dask scheduler answers"),
            open_workers(scheduler=address),
        ):
            pass


def test_a_scheduler_that_goes_is_told_in_words(batches: list[Batch]) -> None:
    with ExitStack() as stack:
        cluster = stack.enter_context(
            LocalCluster(n_workers=1, processes=False, protocol="tcp", dashboard_address="127.0.0.1:0")
        )
        workers = stack.enter_context(open_workers(scheduler=cluster.scheduler_address))
        results = workers.map(batch_work.digest, batches)
        next(results)
        cluster.close()
        with pytest.raises(RigError, match=r"the Dask scheduler at tcp://\S+ is gone"):
            list(results)


def test_workers_of_two_kinds_are_refused() -> None:
    with (
        pytest.raises(ConfigurationError, match="leave it out with --scheduler"),
        open_workers(2, "tcp://a:1"),
    ):
        pass


def test_without_dask_one_process_does_it_and_more_are_refused(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "rig_calib.offline.dask_workers", None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    with open_workers() as workers:
        assert isinstance(workers, ThisProcess)
    assert "pip install 'kinect-rig[offline]'" in caplog.text
    with pytest.raises(ConfigurationError, match=r"kinect-rig\[offline\]"), open_workers(2):
        pass
