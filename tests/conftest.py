"""Tests import their helpers as `support.…`."""

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# A busy machine may hold up any example: how long one takes says nothing about the code.
settings.register_profile("kinect-rig", deadline=None, derandomize=True)
settings.load_profile("kinect-rig")


@pytest.fixture(autouse=True)
def _logging_left_as_found() -> Iterator[None]:
    """A program that a test ran in this process set up logging to a stream that ends with the test."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
