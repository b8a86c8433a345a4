"""The interface of a renderer backend: whether it supports a scene, what it would cost, and the rendering itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from torch import Tensor

from kornia_tidy.render.cost_model import Work
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

    def work(self, scene: LayeredScene) -> Work:
        """Return the work of the forward pass: pairs of tiles and layers, strips, samples.

        :mod:`kornia_tidy.render.cost_model` prices it.
        """
        ...

    def bounds(self, scene: LayeredScene) -> Iterator[Work]:
        """Yield lower bounds of :meth:`work`: one that takes no time, then closer ones that take less time than it."""
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
