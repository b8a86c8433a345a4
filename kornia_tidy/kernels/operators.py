"""Operators of torch in C: their definition, and the structs that they hand to C.

Operators are defined by schema, as ``torch.library.custom_op`` would import the compiler on the first call (3 s).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import torch
from torch import Tensor


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


class Parameters(ctypes.Structure):
    """A struct of C. It keeps the tensors whose memory it names. Its field ``threads`` is filled in."""

    def __init__(self, **numbers: int) -> None:
        super().__init__(threads=torch.get_num_threads(), **numbers)
        self.kept: list[Tensor] = []

    def point_to(self, **tensors: Tensor | None) -> None:
        """Write addresses of tensors to the fields of their names, and strides where there are fields for them.

        Strides of ``plane`` are ``plane_image``, ``plane_channel`` and ``plane_row``: pixels of a row lie side by side.
        Tensors without such fields are contiguous.
        """
        fields = {field[0] for field in self._fields_}
        for name, tensor in tensors.items():
            if tensor is None:
                continue
            strided = f"{name}_row" in fields
            own = tensor if strided and tensor.stride(-1) == 1 else tensor.contiguous()
            setattr(self, name, own.data_ptr())
            self.kept.append(own)
            if strided:
                axes = ("image", "channel", "row") if own.ndim == 4 else ("image", "row")
                for axis, stride in zip(axes, own.stride(), strict=False):
                    setattr(self, f"{name}_{axis}", stride)
