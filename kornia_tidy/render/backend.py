"""The interface of a renderer backend: whether it supports a scene, what it would cost, and the rendering itself."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from kornia_tidy.render.scene import LayeredScene


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
        """Return (B, C, h, w) light, without the stray light of gather and scatter.

        It has gradients with respect to image, layer weight, PSFs and, for occlusion, stray light; these can be
        differentiated in turn.
        """
        ...
