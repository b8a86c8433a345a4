"""Peak memory of a network, counted operation by operation."""

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
    """Return the peak memory of a network for an image, including the image and its output.

    It is the largest sum of all tensors alive after an operation. For a convolution, input and output are counted
    twice unless the input is in channels-last format, as some libraries copy both to another memory layout.

    Args:
        head: the network. Its weights and buffers are not counted.
        image: (B, C, H, W).

    Returns:
        Bytes.

    Example:
        >>> head_bytes(nn.Conv2d(3, 8, 1), torch.rand(1, 3, 10, 10))  # twice input and output
        8800
    """
    with _Living(head) as living:
        image = image.clone()  # so that it is counted
        head(image)
    return living.most


class _Living(TorchDispatchMode):
    """Dispatch mode that sums the memory of all tensors alive after each operation."""

    def __init__(self, head: nn.Module) -> None:
        super().__init__()
        self.most = self._now = 0
        self._known = {part.untyped_storage()._cdata for part in (*head.parameters(), *head.buffers())}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # to skip torch's compiler would import it, for seconds

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        output = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(output):
            if isinstance(tensor, Tensor):
                self._born(tensor.untyped_storage())
        reordered = 0
        if func is torch.ops.aten.convolution.default and not args[0].is_contiguous(memory_format=torch.channels_last):
            reordered = args[0].nbytes + output.nbytes
        self.most = max(self.most, self._now + reordered)
        return output

    def _born(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()  # views of one storage have one key
        if key not in self._known:
            self._known.add(key)
            self._now += size
            weakref.finalize(storage, self._died, key, size)

    def _died(self, key: int, size: int) -> None:
        self._known.discard(key)
        self._now -= size
