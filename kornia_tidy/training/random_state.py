"""States of the global random generators: saving, restoring, and seeding for a block."""

from __future__ import annotations

import math
import random
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
import torch.distributed as dist


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
    """Restore the states of the global generators that :func:`random_state` returned.

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
    np.random.set_state(_of_numpy(state["numpy"]))  # noqa: NPY002
    random.setstate(_of_python(state["python"]))


def check_random_states(states: Any, place: str) -> None:
    """Raise ``ValueError`` unless generators take the states that :func:`random_states` returned, of every process.

    They are tried on generators that nobody draws from.

    Example:
        >>> check_random_states(random_states(), "random")
        >>> check_random_states([{"torch": torch.zeros(3)}], "random")
        Traceback (most recent call last):
        ...
        ValueError: random/0 must be states of the generators of torch, NumPy and Python
    """
    states = [states] if isinstance(states, Mapping) else states
    if not isinstance(states, (list, tuple)) or not states:
        raise ValueError(f"{place} must be the states of the generators of every process, got {states!r:.80}")
    for number, state in enumerate(states):
        try:
            if not isinstance(state, Mapping) or not isinstance(state["cuda"], (list, tuple)):
                raise TypeError
            torch.Generator().set_state(state["torch"])
            if not all(isinstance(each, torch.Tensor) and each.dtype == torch.uint8 for each in state["cuda"]):
                raise TypeError
            np.random.RandomState().set_state(_of_numpy(state["numpy"]))
            random.Random().setstate(_of_python(state["python"]))  # noqa: S311 (the same generator)
        except (AttributeError, KeyError, OverflowError, RuntimeError, TypeError, ValueError):
            raise ValueError(f"{place}/{number} must be states of the generators of torch, NumPy and Python") from None


def _of_numpy(state: Any) -> tuple[Any, ...]:
    name, words, position, has_gauss, gauss = state
    if not isinstance(words, torch.Tensor) or not isinstance(gauss, (int, float)) or not math.isfinite(gauss):
        raise TypeError
    if not isinstance(position, int) or not 0 <= position <= len(words) or not isinstance(has_gauss, int):
        raise ValueError
    return name, words.numpy().astype(np.uint32), position, has_gauss, gauss


def _of_python(state: Any) -> tuple[Any, ...]:
    version, own, spare = state
    if not isinstance(own, torch.Tensor) or not isinstance(spare, (int, float, type(None))):
        raise TypeError
    if not math.isfinite(spare or 0):
        raise ValueError
    return version, tuple(own.tolist()), spare


def random_states() -> list[dict[str, Any]]:
    """Return :func:`random_state` of every process of a run, by rank; all processes must call it."""
    if not (dist.is_available() and dist.is_initialized()):
        return [random_state()]
    states: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(states, random_state())  # pickles, but only between processes of one run
    return states


def own_random_state(states: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return this process's entry of the states that :func:`random_states` returned.

    If there are more processes than states, the states are reused in turn. A single state, as in checkpoints of early
    versions, is for all processes.
    """
    if isinstance(states, Mapping):
        return states
    rank = dist.get_rank() if dist.is_available() and dist.is_initialized() else 0
    return states[rank % len(states)]


@contextmanager
def seeded(seed: int) -> Generator[None]:
    """Seed the global generators of the CPU for a block, and restore their states after it.

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
