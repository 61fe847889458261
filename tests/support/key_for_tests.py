"""The key of one test run."""

import atexit
import os
import secrets
import tempfile
from functools import cache
from pathlib import Path

from rig_protocol.key_file import write_key
from rig_protocol.rig_key import RigKey

_VARIABLE = "TEST_RIG_KEY"


@cache
def rig_key_file() -> Path:
    """The key that servers and agents of one test run share; programs that it starts inherit it."""
    inherited = os.environ.get(_VARIABLE)
    if inherited:
        return Path(inherited)
    folder = tempfile.TemporaryDirectory(prefix="rig-key-")
    atexit.register(folder.cleanup)
    write_key(path := Path(folder.name) / "rig.key", RigKey.generate(secrets.token_bytes))
    os.environ[_VARIABLE] = str(path)
    return path
