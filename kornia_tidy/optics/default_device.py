"""Functions with tensors on the CPU for any default device."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")


def on_cpu(function: Callable[_Given, _Found]) -> Callable[_Given, _Found]:
    """Return a function that makes its tensors on the CPU unless it names another device.

    Example:
        >>> torch.set_default_device("meta")
        >>> on_cpu(torch.zeros)(1).device, torch.zeros(1).device
        (device(type='cpu'), device(type='meta'))
        >>> torch.set_default_device(None)
    """

    @wraps(function)
    def there(*args: _Given.args, **options: _Given.kwargs) -> _Found:
        if torch.empty(0).is_cpu:  # each call of torch takes longer in the context
            return function(*args, **options)
        with torch.device("cpu"):
            return function(*args, **options)

    return there
