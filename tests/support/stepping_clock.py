"""A clock that can be made to jump, put in before a program reads the time; the machine's own is not touched.

Import it first. SIGUSR1 sets this process's monotonic clock one hour ahead, SIGUSR2 one hour back. As a
program: python tests/support/stepping_clock.py MODULE ARGUMENTS... runs MODULE so.
"""

import runpy
import signal
import sys
import time

STEP_NS = 3_600 * 10**9
_true_ns = time.monotonic_ns
_offset_ns = 0


def true_time_s() -> float:
    """The monotonic clock that does not jump."""
    return _true_ns() / 1e9


def _stepped_ns() -> int:
    return _true_ns() + _offset_ns


def _step(ahead_ns: int) -> None:
    global _offset_ns  # one clock a process
    _offset_ns += ahead_ns


time.monotonic_ns = _stepped_ns
signal.signal(signal.SIGUSR1, lambda *_: _step(STEP_NS))
signal.signal(signal.SIGUSR2, lambda *_: _step(-STEP_NS))

if __name__ == "__main__":
    module, sys.argv = sys.argv[1], sys.argv[1:]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
