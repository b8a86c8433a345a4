"""How much memory a network takes, counted."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


@torch.no_grad()
def head_bytes(head: nn.Module, image: Tensor) -> int:
    """Return the most memory that a network takes at one time for an image, the image and its output included.

    What is alive after each operation is added up. A convolution is given its input and output once more, for libraries
    that bring both into an order of their own.

    Args:
        head: the network. Its weights are not counted.
        image: (B, C, H, W).

    Returns:
        Bytes.

    Example:
        >>> head_bytes(nn.Conv2d(3, 8, 1), torch.rand(1, 3, 10, 10))  # twice what goes in and comes out
        8800
    """
    with _Living() as living:
        image = image.clone()  # which is counted so
        head(image)
    return living.most


class _Living(TorchDispatchMode):
    """Adds up the memory of the tensors that are alive, operation by operation."""

    def __init__(self) -> None:
        super().__init__()
        self.most = self._now = 0
        self._known: set[int] = set()

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        output = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(output):
            if isinstance(tensor, Tensor):
                self._born(tensor.untyped_storage())
        reordered = 0
        if func is torch.ops.aten.convolution.default:
            reordered = args[0].nbytes + output.nbytes
        self.most = max(self.most, self._now + reordered)
        return output

    def _born(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()  # two views of one memory have one key
        if key not in self._known:
            self._known.add(key)
            self._now += size
            weakref.finalize(storage, self._died, key, size)

    def _died(self, key: int, size: int) -> None:
        self._known.discard(key)
        self._now -= size
