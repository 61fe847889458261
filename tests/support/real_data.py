"""Where tests find recorded sensor data; it is not part of the repository."""

import os
from pathlib import Path

import pytest

_REPOSITORY = Path(__file__).resolve().parents[2]


def real_data(name: str) -> Path:
    """The folder of one data set, or a skip that says how to provide it."""
    root = Path(os.environ.get("RIG_REAL_DATA", _REPOSITORY.parent / "shared" / "data"))
    folder = root / name
    if not folder.is_dir():
        pytest.skip(f"real data {folder} is absent: point RIG_REAL_DATA at a folder that holds {name}/")
    return folder
