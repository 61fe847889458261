"""One piece of work at a time in a thread of its own, which ends early when it is given up."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from types import TracebackType
from typing import Generic, Self, TypeVar

Result = TypeVar("Result")
Tell = Callable[[str, float], None]


class BackgroundWork(Generic[Result]):
    """Work that tells its progress, which is where it ends when it is given up.

    A context manager, whose end gives the work up and does not wait for it: Ctrl-C ends the program at once.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._future: Future[Result] | None = None
        self._given_up = threading.Event()

    def __enter__(self) -> Self:
        """Nothing runs yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give up what runs."""
        self.give_up()

    @property
    def busy(self) -> bool:
        """Whether there is work whose result has not been taken."""
        return self._future is not None

    def start(self, work: Callable[[Tell], Result], tell: Tell) -> None:
        """Begin `work`, which is handed a `tell` of its own and must call it now and then."""
        if self.busy:
            raise RuntimeError("the work before is not done")
        given_up, future = threading.Event(), Future[Result]()
        self._given_up, self._future = given_up, future

        def tell_unless_given_up(stage: str, share: float) -> None:
            if given_up.is_set():
                raise _GivenUpError
            tell(stage, share)

        def run() -> None:
            try:
                future.set_result(work(tell_unless_given_up))
            except BaseException as error:  # whoever takes the result gets it
                future.set_exception(error)

        threading.Thread(target=run, name=self._name, daemon=True).start()

    def give_up(self) -> None:
        """End what runs, soon; `busy` until it has ended."""
        self._given_up.set()

    def take(self, timeout_s: float) -> Result | None:
        """The result, once; None when it does not come within `timeout_s` or was given up. Raises errors."""
        if self._future is None:
            return None
        wait([self._future], timeout_s)
        if not self._future.done():
            return None
        future, self._future = self._future, None
        try:
            return future.result()
        except _GivenUpError:
            return None


class _GivenUpError(Exception):
    """Nobody wants the result any more."""
