"""Freed memory that stays in the process, for programs that make images at a steady pace."""

import numpy as np

_LARGEST_KEPT = 8 << 20
"""Bytes; the temporary images of a codec together. Twice this much may lie unused: little even on a Pi."""


def keep_freed_memory() -> None:
    """Let the C library reuse the memory of freed images instead of returning it: call once at the start.

    glibc gives large blocks back to the kernel, so that an encoder's temporary images cost a page fault every
    4 KiB, and half of the encoder's time. Freeing one mapped block raises both limits: blocks up to
    its size are no longer mapped, and only twice its size is given back (M_MMAP_THRESHOLD in mallopt(3)).
    Without effect under other C libraries. The block is never touched and takes no memory.
    """
    np.empty(_LARGEST_KEPT, np.uint8)
