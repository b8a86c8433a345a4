"""Where randomness comes from in training: states that can be saved, and seeds that follow from what they are for."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch


def keyed_seed(*keys: int | str) -> int:
    """Return a seed that depends on these keys only; those of neighbours are unrelated.

    Example:
        >>> keyed_seed(0, "noise", 3) == keyed_seed(0, "noise", 3) != keyed_seed(0, "noise", 4)
        True
    """
    digest = hashlib.sha256("/".join(map(str, keys)).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1  # what every generator takes: 63 bits


def random_state() -> dict[str, Any]:
    """Return the states of the global generators of torch (every device), NumPy and Python, as tensors and numbers."""
    name, words, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 (other libraries draw from it)
    version, own, spare = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [name, torch.from_numpy(np.asarray(words, np.int64)), position, has_gauss, gauss],
        "python": [version, torch.tensor(own, dtype=torch.int64), spare],
    }


def set_random_state(state: Mapping[str, Any]) -> None:
    """Set the global generators to what :func:`random_state` returned.

    Example:
        >>> state = random_state()
        >>> a = torch.rand(2), np.random.rand(), random.random()
        >>> set_random_state(state)
        >>> torch.equal(a[0], torch.rand(2)), a[1] == np.random.rand(), a[2] == random.random()
        (True, True, True)
    """
    torch.set_rng_state(state["torch"])
    if len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["cuda"])
    name, words, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, words.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    version, own, spare = state["python"]
    random.setstate((version, tuple(own.tolist()), spare))


@contextmanager
def seeded(seed: int) -> Generator[None]:
    """Seed the CPU's global generators for a block, and put them back as they were.

    Example:
        >>> with seeded(3):
        ...     a = torch.rand(1)
        >>> with seeded(3):
        ...     torch.equal(a, torch.rand(1))
        True
    """
    before = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    torch.random.default_generator.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    random.seed(seed)
    try:
        yield
    finally:
        torch.set_rng_state(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        random.setstate(before[2])
