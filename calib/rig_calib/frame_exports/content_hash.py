"""What tells two calibrations, or other documents, apart in a few characters."""

import hashlib
import json
from typing import Any


def content_hash(values: Any) -> str:
    """SHA-256, in hexadecimal, of what JSON can hold; the order of keys does not matter."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
