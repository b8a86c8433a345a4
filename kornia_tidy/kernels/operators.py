"""Operators of torch in C: their definition, the checks of their tensors, and the structs that they hand to C.

Operators are defined by schema, as ``torch.library.custom_op`` would import the compiler on the first call (3 s).
"""

from __future__ import annotations

import ctypes
import inspect
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn, ParamSpec, TypeVar

import torch
from torch import Tensor

NO_MEMORY = 1  # status of functions in C, see vectors.h

_TYPES = {
    "int": "SymInt",
    "Tensor | None": "Tensor?",
    "Sequence[Tensor]": "Tensor[]",
    "Sequence[Tensor] | None": "Tensor[]?",
    "Sequence[bool]": "bool[]",
}
_RESULTS = {"Tensor": "Tensor", "list[Tensor]": "Tensor[]", "tuple[Tensor, Tensor]": "(Tensor, Tensor)"}

Given = ParamSpec("Given")
Result = TypeVar("Result")


def operator(
    backward: Callable[..., Any] | None = None, keep: Callable[..., None] | None = None
) -> Callable[[Callable[Given, Iterator[Result]]], Callable[Given, Result]]:
    """Make a generator function an operator on processors ``kornia_tidy::<name>``, with the schema of its annotations.

    It checks its arguments and yields the memory of its result, which is all that tensors without memory ask for. Then
    it fills the memory.

    Args:
        backward: as for :func:`define`.
        keep: as there.

    Example:
        >>> from kornia_tidy.kernels.gather_ops import gather_direct
        >>> str(gather_direct._schema).endswith("bool correlate=False, bool weight_gradient=False) -> Tensor")
        True
    """

    def defined(function: Any) -> Any:
        name = function.__name__.lstrip("_")

        def fake(*given: Any) -> Any:
            return next(function(*given))

        def compute(*given: Any) -> Any:
            (result,) = function(*given)
            return result

        define(name, _schema(function), compute, fake, backward, keep)
        return getattr(torch.ops.kornia_tidy, name).default

    return defined


def _schema(function: Callable[..., Any]) -> str:
    signature = inspect.signature(function)
    arguments = (
        f"{_TYPES.get(x.annotation, x.annotation)} {name}{'' if x.default is x.empty else f'={x.default}'}"
        for name, x in signature.parameters.items()
    )
    return f"({', '.join(arguments)}) -> {_RESULTS[signature.return_annotation[len('Iterator[') : -1]]}"


def define(
    name: str,
    schema: str,
    compute: Callable[..., Any],
    fake: Callable[..., Any],
    backward: Callable[..., Any] | None = None,
    keep: Callable[..., None] | None = None,
    devices: str = "CPU",
) -> None:
    """Define an operator ``kornia_tidy::<name>``.

    Args:
        name: of the operator.
        schema: arguments and result, as ``torch.library.define`` takes them.
        compute: the implementation.
        fake: returns the memory of the result, also for tensors without memory.
        backward: its gradient, as ``torch.library.register_autograd`` takes it. Without one it refuses to have any.
        keep: saves what ``backward`` needs.
        devices: that ``compute`` is for, as ``torch.library.impl`` takes them; ``"default"``: all.
    """
    operator = f"kornia_tidy::{name}"

    def refuse(ctx: Any, *gradients: Any) -> NoReturn:
        raise NotImplementedError(
            f"{operator} has no gradient: differentiate functions of kornia_tidy.render or kornia_tidy.psf instead"
        )

    torch.library.define(operator, schema)
    torch.library.impl(operator, devices, compute)
    torch.library.register_fake(operator, fake)
    torch.library.register_autograd(operator, backward or refuse, setup_context=keep)


def differentiable_gradients(
    function: Callable[..., Tensor], inputs: Sequence[Tensor | None], gradient: Tensor, wanted: Sequence[bool]
) -> list[Tensor | None]:
    """Return gradients of a function of plain operations, which can be differentiated in turn.

    Args:
        function: of the inputs.
        inputs: tensors, or None.
        gradient: of its result.
        wanted: inputs that need a gradient.

    Example:
        >>> x = torch.tensor(3.0, requires_grad=True)
        >>> (gradient,) = differentiable_gradients(lambda x: x**3, [x], torch.tensor(1.0), [True])
        >>> gradient.item(), torch.autograd.grad(gradient, x)[0].item()
        (27.0, 18.0)
    """
    with torch.enable_grad():
        # Views, so that a gradient ends here, though one input may be made of another.
        own = [None if x is None else x.view_as(x) for x in inputs]
        asked = [x for x, want in zip(own, wanted, strict=True) if want and x is not None]
        result = function(*own)
        found = torch.autograd.grad(result, asked, gradient.to(result), create_graph=True, allow_unused=True)
    each = iter(found)
    return [next(each) if want and x is not None else None for x, want in zip(own, wanted, strict=True)]


def check(sizes: dict[str, int], dtype: torch.dtype | None, **tensors: tuple[Tensor | None, str]) -> None:
    """Refuse tensors of another data type, or whose axes are not of one size wherever they have one name.

    Args:
        sizes: of axes by name. Those that are new are added.
        dtype: of all; None: any.
        tensors: by name, each with the names of its axes. None has no axes.

    Raises:
        TypeError: if a data type differs.
        ValueError: if a shape does not fit.

    Example:
        >>> sizes = {"B": 2}
        >>> check(sizes, torch.float32, image=(torch.ones(2, 5), "B N"))
        >>> check(sizes, None, mean=(torch.ones(3), "N"))
        Traceback (most recent call last):
        ValueError: mean must have shape (5), got (3,)
    """
    for name, (tensor, axes) in tensors.items():
        if tensor is None:
            continue
        if dtype not in {None, tensor.dtype}:
            raise TypeError(f"{name} must be {dtype}, got {tensor.dtype}")
        names, known = axes.split(), sizes.copy()
        found = zip(names, tensor.shape, strict=False)
        if tensor.ndim != len(names) or any(sizes.setdefault(x, int(x) if x.isdigit() else n) != n for x, n in found):
            wanted = ", ".join(str(known.get(axis, axis)) for axis in names)
            raise ValueError(f"{name} must have shape ({wanted}), got {tuple(tensor.shape)}")


def strided(tensor: Tensor | None, axes: int = 4) -> tuple[Any, ...]:
    """Return a tensor whose rows are dense with its strides along the other axes: as many fields for :func:`call`.

    Example:
        >>> strided(torch.ones(5, 3).expand(2, -1, -1))[1:], strided(None, 3)
        ((0, 3), (None, 0, 0))
    """
    if tensor is None:
        return None, *(0,) * (axes - 1)
    own = tensor if tensor.stride(-1) == 1 else tensor.contiguous()
    return own, *own.stride()[:-1]


def call(function: Any, *fields: Tensor | float | tuple[Any, ...] | None) -> int:
    """Call a function in C with the address of a struct, and return its status.

    Args:
        function: of a library.
        fields: of the struct after the first one, which is the number of threads. All are of 64 bits: whole numbers,
            double ones, and pointers to tensors, which are made contiguous. None is a null pointer. A tuple holds
            several fields, with tensors as they lie in memory.

    Raises:
        MemoryError: if memory is missing.
    """
    kept: list[Any] = []
    for x in fields:
        kept += x if isinstance(x, tuple) else [x.contiguous()] if isinstance(x, Tensor) else [x or 0]
    words = [x.data_ptr() if hasattr(x, "data_ptr") else x or 0 for x in kept]
    kinds = "".join(["d" if type(x) is float else "q" for x in words])
    status = function(ctypes.c_char_p(struct.pack(f"q{kinds}", torch.get_num_threads(), *words)))
    if status == NO_MEMORY:
        shapes = ", ".join(str(tuple(x.shape)) for x in kept if isinstance(x, Tensor))
        raise MemoryError(f"there is no memory for {function.__name__} of tensors of shapes {shapes}")
    return status
