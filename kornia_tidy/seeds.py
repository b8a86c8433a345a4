"""Seeds that follow from what they are for, so that no draw depends on the draws before it."""

from __future__ import annotations

import hashlib


def keyed_seed(*keys: int | str) -> int:
    """Return a seed that depends on these keys only; those of neighbours are unrelated.

    Example:
        >>> keyed_seed(0, "noise", 3) == keyed_seed(0, "noise", 3) != keyed_seed(0, "noise", 4)
        True
    """
    digest = hashlib.sha256("/".join(map(str, keys)).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1  # what every generator takes: 63 bits
