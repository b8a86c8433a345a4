"""Memory that the C library keeps from one chunk to the next instead of giving it back to the system."""

from __future__ import annotations

from functools import cache

import torch

BLOCK_BYTES = 31 << 20  # the largest that glibc learns from is 32 MiB


@cache
def keep_memory() -> None:
    """Let the process keep up to 62 MiB of free memory, from now on.

    Transforms allocate their results, some MiB for each chunk. glibc gives free memory back to the system above
    twice the largest block so far that it had from there directly, and fetching it again takes up to half as long as
    the transforms themselves. Taking one large block, and letting it go, teaches it. Nothing is written to the block,
    so that it takes no time and no memory. Other C libraries have their own ways, and where the user has set
    ``MALLOC_MMAP_THRESHOLD_``, that stands.

    Source: mallopt(3), M_MMAP_THRESHOLD and M_TRIM_THRESHOLD.

    Example:
        >>> keep_memory()
    """
    torch.empty(BLOCK_BYTES, dtype=torch.uint8)
