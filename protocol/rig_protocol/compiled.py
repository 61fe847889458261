"""Loops compiled to machine code with Numba, on the PC only: imported by the modules that hold such loops.

They run without the interpreter's lock and never reorder arithmetic: the same input gives the same bits.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")

# A division that may raise an error keeps loops from becoming vector instructions.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def compiled(signature: object = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile now for a signature, or at the first call; from the cache where there is one.

    The cache looks at the function's own file alone: constants and functions of other files are compiled in.
    """

    def compile_function(function: Callable[P, R]) -> Callable[P, R]:
        try:
            machine_code: Callable[P, R] = numba.njit(signature, cache=True, **_OPTIONS)(function)
        except (RuntimeError, OSError):  # neither the installation nor the user's cache folder takes it
            machine_code = numba.njit(signature, **_OPTIONS)(function)
        return machine_code

    return compile_function


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Part of the compiled functions that call it."""
    machine_code: Callable[P, R] = numba.njit(**_OPTIONS)(function)
    return machine_code
