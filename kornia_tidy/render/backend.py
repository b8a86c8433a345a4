"""The interface of a renderer backend: whether it supports a scene, its work, and the rendering itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from kornia_tidy.render.borders import transform_side
from kornia_tidy.render.scene import LayeredScene

GradientPairs = list[tuple[Tensor, Tensor]]  # a tensor and its gradient


def gradient_pairs(tensors: Sequence[Tensor | None], gradients: Sequence[Tensor | None]) -> GradientPairs:
    """Return the tensors that have a gradient, with their gradients.

    Args:
        tensors: tensors, or None.
        gradients: of the tensors, or None.
    """
    pairs = zip(tensors, gradients, strict=True)
    return [(tensor, gradient) for tensor, gradient in pairs if tensor is not None and gradient is not None]


def wants_gradient(tensor: Tensor | None) -> bool:
    """Return whether a tensor is there and requires a gradient."""
    return tensor is not None and tensor.requires_grad


@dataclass(frozen=True)
class Work:
    """Work of a backend for a scene, without gradients.

    Args:
        operations: additions and multiplications, roughly: for comparisons. Those of float64 count twice.
        memory: bytes at a time beyond the image.
        window: side of the windows that are transformed in samples; 0 if none are.
    """

    operations: float
    memory: int
    window: int = 0

    def __str__(self) -> str:
        """Describe in words."""
        windows = f"windows of {self.window} px, " if self.window else ""
        return f"{windows}{self.operations:.2g} operations, {self.memory / 2**20:.0f} MiB"


def transform_operations(height: int, width: int) -> float:
    """Return the operations of a Fourier transform of a real plane, padded to a size that is fast.

    Example:
        >>> transform_operations(64, 64) / 64**2
        30.0
    """
    samples = transform_side(height) * transform_side(width)
    return 2.5 * samples * math.log2(samples)


class Backend(Protocol):
    """A way to render a layered scene. All backends give the same image to rounding."""

    @property
    def name(self) -> str:
        """What ``method=`` calls it."""

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why it does not support a scene, as the end of a sentence, or None if it does."""

    def work(self, scene: LayeredScene) -> Work:
        """Return the work of the forward pass, counted from the layers of the pixels and from no light or PSF."""

    def render(self, scene: LayeredScene) -> Tensor:
        """Return (B, C, h, w) light, without the stray light of gather and scatter. Autograd does not record it."""

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of tensors that were made of the scene's, where they require gradients.

        Args:
            scene: tensors that autograd records: image, layer weight, PSFs and, for occlusion, stray light.
            gradient: (B, C, h, w) gradient of what :meth:`render` returns.
        """
