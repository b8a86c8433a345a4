"""Rows of graphics processors: captures on CUDA where there is one, and with products rounded to TF32 everywhere.

TF32 keeps 10 bits after the leading one of what is multiplied, against 23 of float32. Where it is allowed, GPUs of
Nvidia compute products of matrices and convolutions of float32 in it. The rows without a GPU run on the simulated
device of the tests, which takes the operations that a GPU would, and rounds those inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from kornia_tidy import DwellTimes, TiDyOptics
from kornia_tidy.modulator import PixelCrosstalk, SpatialLightModulator
from tests.extremes.exposure import camera
from tests.extremes.lens import BOUND, CAPTURE
from tests.extremes.row import Row, difference, scene, worst
from tests.simulated_device import SimulatedDevice, SimulatedTensor

GROUP = "Graphics processors"
ABSENT = "" if torch.cuda.is_available() else "no GPU on this machine"
ROUNDED = {"mm", "bmm", "addmm", "baddbmm", "mv", "addmv", "dot", "convolution", "_convolution"}


def tf32(tensor: Tensor) -> Tensor:
    """Return float32 or complex64 values rounded to the nearest TF32, ties to even; other types as they are."""
    if tensor.dtype == torch.complex64:
        return torch.view_as_complex(tf32(torch.view_as_real(tensor.resolve_conj()).contiguous()))
    if tensor.dtype != torch.float32:
        return tensor
    bits = tensor.contiguous().view(torch.int32)
    return ((bits + 0xFFF + ((bits >> 13) & 1)) & ~0x1FFF).view(torch.float32)


class TF32Device(SimulatedDevice):
    """A simulated device that multiplies matrices and convolves in TF32."""

    def _computed(self, operator: Any, name: str, args: Any, kwargs: dict[str, Any], target: bool) -> Any:
        if name in ROUNDED:
            args = tree_map_only(SimulatedTensor, lambda x: SimulatedTensor(tf32(x.on_cpu)), args)
        return super()._computed(operator, name, args, kwargs, target)


def cameras() -> list[TiDyOptics]:
    """Return a camera for each way of computing PSFs, and one whose panel has crosstalk."""
    panel = SpatialLightModulator(PixelCrosstalk(0.5), DwellTimes())
    return [
        camera(masks=2),
        camera(masks=5, fidelity="balanced"),
        camera(modulator=panel),
        camera(masks=5, fidelity="paper", color_space="paper"),
    ]


def _error(put: Callable[[Any], Any], fetch: Callable[[Tensor], Tensor], *, gradients: bool = True) -> float:
    """Captures on a device against float64 on the CPU; NaN where a gradient is not finite."""
    image, depth = scene()
    errors = []
    for optics in cameras():
        with torch.no_grad():
            expected = optics(image.float().double(), depth.float().double())
        there = put(optics)
        captured = there(put(image.float()), put(depth.float()))
        errors.append(difference(fetch(captured.detach()), expected))
        if gradients:
            captured.square().mean().backward()
            gradient = there.masks.phase.grad
            errors.append(0.0 if gradient is not None and bool(fetch(gradient).isfinite().all()) else math.nan)
    return worst(errors)


def _simulated() -> float:
    with TF32Device() as device:
        return _error(device.put, lambda tensor: tensor.on_cpu if isinstance(tensor, SimulatedTensor) else tensor)


@contextmanager
def _products(*, allowed: bool) -> Iterator[None]:
    """Allow TF32, or not, in products of matrices and convolutions on CUDA."""
    parts = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [part.allow_tf32 for part in parts]
    try:
        for part in parts:
            part.allow_tf32 = allowed
        yield
    finally:
        for part, value in zip(parts, before, strict=True):
            part.allow_tf32 = value


def _on_cuda(*, allowed: bool) -> float:
    with _products(allowed=allowed):
        return _error(lambda value: value.to("cuda"), Tensor.cpu)


def _half_on_cuda(dtype: torch.dtype) -> float:
    """In units of the type's rounding at full scale."""
    image, depth = (part.cuda() for part in scene())
    optics = camera().cuda()
    with torch.no_grad():
        found, single = (optics(image.to(dtype).to(kind), depth.float()) for kind in (dtype, torch.float32))
    assert found.dtype == dtype
    return difference(found, single) / (torch.finfo(dtype).eps / 2)


def rows() -> list[Row]:
    """Return the rows of graphics processors."""
    tried = "presets draft, balanced and paper, a panel with crosstalk; gradients finite"
    rounding = "rounding of the type at 1, from float32 on the GPU"
    return [
        Row(GROUP, "TF32, simulated", tried, _simulated, BOUND, CAPTURE,
            "inputs of matrix products and convolutions rounded to 10 bits", slow=True),
        Row(GROUP, "GPU, TF32 off", tried, lambda: _on_cuda(allowed=False), BOUND, CAPTURE, absent=ABSENT),
        Row(GROUP, "GPU, TF32 on", tried, lambda: _on_cuda(allowed=True), BOUND, CAPTURE, absent=ABSENT),
        *(Row(GROUP, f"GPU, {str(dtype).removeprefix('torch.')}", "images of this type",
              lambda dtype=dtype: _half_on_cuda(dtype), 1.0, rounding, absent=ABSENT)
          for dtype in (torch.float16, torch.bfloat16)),
    ]  # fmt: skip
