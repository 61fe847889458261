"""Workers on Dask: processes of this machine, or those of a cluster."""

import logging
import os
import signal
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import cv2
import dask
from distributed import Client, Future, LocalCluster, wait
from distributed.scheduler import KilledWorker
from distributed.security import Security
from distributed.utils import silence_logging_cmgr

from rig_calib.offline.capture import Capture
from rig_calib.offline.worker_check import check_workers
from rig_calib.offline.workers import Batch, Tell, ThisProcess
from rig_protocol.codecs import keep_freed_memory
from rig_protocol.errors import ConfigurationError, RigError

Result = TypeVar("Result")

_AHEAD = 2  # batches a worker that nobody has taken yet
_DEATHS = 3  # of workers that a batch may see and be tried again
CONNECT_S = 10.0
_PATIENCE_S = 60.0  # with workers that have all gone: Dask starts new ones, but not always
_LOOK_S = 2.0
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
_SETTINGS = {"distributed.admin.large-graph-warning-threshold": "1GB"}  # a capture of hours is some 10 MB
LOCAL_SETTINGS: dict[str, Any] = {
    **_SETTINGS,
    "distributed.scheduler.allowed-failures": _DEATHS,
    "distributed.scheduler.http.routes": [],  # pages for everybody who has an account here
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,
    "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
}


@contextmanager
def open_processes(count: int) -> Iterator["DaskWorkers"]:
    """`count` processes of this machine, started with the first work of more than one batch."""
    with ExitStack() as stack:
        try:
            yield DaskWorkers(lambda: _start_processes(stack, count))
        finally:
            with _interrupts_held():
                stack.close()


@contextmanager
def open_cluster(address: str) -> Iterator["DaskWorkers"]:
    """The workers of the scheduler at `address`, as tcp://10.0.0.1:8786; ConfigurationError if none is there.

    For tls:// Dask's own configuration names the certificates.
    """
    with _quiet(), dask.config.set(_SETTINGS):
        try:
            client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TypeError, ValueError) as error:
            raise ConfigurationError(
                f"no Dask scheduler answers at {address}: start one with `dask scheduler`, and give the "
                "address that it prints"
            ) from error
        with client:
            yield DaskWorkers(lambda: client, address)


class DaskWorkers:
    """Batches go to whoever is free; a batch whose worker dies goes to another."""

    def __init__(self, connect: Callable[[], Client], address: str | None = None) -> None:
        """`address`: of a cluster that others have started."""
        self._connect, self._address = connect, address
        self._client: Client | None = None

    def map(
        self, work: Callable[[Batch], Result], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Result]:
        """The results in order; RigError when a batch's workers die, or when the scheduler is lost."""
        if len(batches) < 2 and self._address is None:
            yield from ThisProcess().map(work, batches, tell)
            return
        client = self._client = self._client or self._connect()
        captures = {id(batch.capture): batch.capture for batch in batches}
        if self._address is not None:
            check_workers(client, self._address, captures.values())
        # A capture crosses once to each worker, not with each of its batches.
        held = {key: client.submit(_itself, capture, pure=False) for key, capture in captures.items()}
        ahead, sent = _AHEAD * max(1, sum(client.nthreads().values())), deque[Future[Any]]()
        try:
            for done in range(len(batches)):
                for coming in batches[done + len(sent) : done + ahead]:
                    capture = held[id(coming.capture)]
                    sent.append(client.submit(_work_on, work, capture, coming.positions, pure=False))
                in_work = batches[done : done + len(sent)]
                yield self._result(client, sent.popleft(), in_work)
                if tell is not None:
                    tell((done + 1) / len(batches))
        finally:
            sent.clear()  # what nobody waits for is not begun

    def _result(self, client: Client, future: Future[Any], in_work: Sequence[Batch]) -> Any:
        try:
            self._wait(client, future)
            return future.result()
        except KilledWorker as error:
            first, last = in_work[0].positions[0], in_work[-1].positions[-1]
            raise RigError(
                f"{in_work[0].capture.path}: workers died {error.allowed_failures + 1} times while "
                f"frames {first} to {last} (counted from 0) were in work. Where memory runs out, ask for "
                "fewer --workers; where a frame does it, leave it out by --first and --frames"
            ) from error
        except (Exception, CancelledError) as error:
            if future.status in ("cancelled", "lost"):
                raise RigError(f"the Dask scheduler {self._of} is gone: begin anew") from error
            raise

    def _wait(self, client: Client, future: Future[Any]) -> None:
        """Until it is done; RigError when there has been nobody to do it for a while."""
        give_up_s = time.monotonic() + _PATIENCE_S
        while True:
            try:
                with client.as_current():
                    wait(future, timeout=_LOOK_S)
            except TimeoutError:
                if client.nthreads():
                    give_up_s = time.monotonic() + _PATIENCE_S
                elif time.monotonic() > give_up_s:
                    raise RigError(f"all workers {self._of} have died: is there enough memory?") from None
            else:
                return

    @property
    def _of(self) -> str:
        return "of this machine" if self._address is None else f"at {self._address}"


def _itself(capture: Capture) -> Capture:
    return capture


def _work_on(work: Callable[[Batch], Result], capture: Capture, positions: range) -> Result:
    cv2.setNumThreads(1)  # the workers have the cores among them
    keep_freed_memory()
    return work(Batch(capture, positions))


def _start_processes(stack: ExitStack, count: int) -> Client:
    """Only who holds the keys that are made here can speak to them: what they are told is what they run."""
    resource_tracker.ensure_running()  # it would let the interrupts through that are held here
    stack.enter_context(_environment_kept())
    with _interrupts_held(), _environment_kept():
        stack.enter_context(dask.config.set(LOCAL_SETTINGS))
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rig-calib-"))
        cluster = stack.enter_context(_processes(count, folder))
        stack.enter_context(_quiet())
        client = Client(cluster, set_as_default=False, direct_to_workers=True)
        stack.enter_context(client)
        return client


def _processes(count: int, folder: str) -> LocalCluster:
    try:
        return LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            host="127.0.0.1",
            protocol="tls://",
            security=Security.temporary(),
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            memory_limit=None,
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        )
    except (RuntimeError, OSError) as error:
        raise RigError(f"{count} processes do not start ({error}): fewer --workers need less") from error


def _quiet() -> AbstractContextManager[ExitStack]:
    """What distributed logs is for people who know it; ours get a sentence."""
    stack = ExitStack()
    for name in ("distributed", "distributed.client"):
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL, name))
    return stack


@contextmanager
def _environment_kept() -> Iterator[None]:
    """Dask tells processes their environment by way of ours."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C comes afterwards. Threads and processes that start here never get it: this one ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
