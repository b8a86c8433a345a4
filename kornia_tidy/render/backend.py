"""The interface of a renderer backend: whether it supports a scene, what it would cost, and the rendering itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

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


class Backend(Protocol):
    """A way to render a layered scene. All backends give the same image to rounding."""

    @property
    def name(self) -> str:
        """What ``method=`` calls it."""
        ...

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why it does not support a scene, as the end of a sentence, or None if it does."""
        ...

    def seconds(self, scene: LayeredScene) -> float:
        """Return the estimated time of the forward pass on as many threads as torch has.

        The backend counts (pairs of tiles and layers, strips, samples); the formulas turn counts into time.
        """
        ...

    def least_seconds(self, scene: LayeredScene) -> float:
        """Return a lower bound of :meth:`seconds` that takes no time: it depends on shapes alone."""
        ...

    def render(self, scene: LayeredScene) -> Tensor:
        """Return (B, C, h, w) light, without the stray light of gather and scatter. Autograd does not record it."""
        ...

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of tensors that were made of the scene's, where they require gradients.

        Args:
            scene: tensors that autograd records: image, layer weight, PSFs and, for occlusion, stray light.
            gradient: (B, C, h, w) gradient of what :meth:`render` returns.
        """
        ...
