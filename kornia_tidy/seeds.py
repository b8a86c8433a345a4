"""Random seeds derived from keys, so that no draw depends on the draws before it."""

from __future__ import annotations

import hashlib

import torch


def keyed_seed(*keys: int | str) -> int:
    """Return a seed determined only by these keys; similar keys give unrelated seeds.

    Example:
        >>> keyed_seed(0, "noise", 3) == keyed_seed(0, "noise", 3) != keyed_seed(0, "noise", 4)
        True
    """
    digest = hashlib.sha256("/".join(map(str, keys)).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1  # 63 bits are valid for every generator


def item_generator(seed: int, item: int) -> torch.Generator:
    """Return a generator that depends on a seed and an item's number only; neighbours are unrelated.

    Example:
        >>> int(torch.randint(100, (1,), generator=item_generator(0, 1)))
        33
    """
    digest = hashlib.sha256(f"{seed}/{item}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little", signed=True))
