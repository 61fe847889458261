"""Loops compile wherever the program is installed."""

from collections.abc import Callable
from typing import Any

import numba
import pytest

from rig_protocol.compiled import compiled


@pytest.mark.parametrize("error", [RuntimeError("no locator available"), OSError("read-only file system")])
def test_an_installation_without_a_writable_cache_still_works(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def njit(*_: object, cache: bool = False, **__: object) -> Callable[[Any], Any]:
        if cache:
            raise error
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)

    @compiled(numba.int64(numba.int64))
    def double(number: int) -> int:
        return 2 * number

    assert double(4) == 8
