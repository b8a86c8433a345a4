"""The interface of a renderer backend: whether it supports a scene, what it would cost, and the rendering itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from torch import Tensor

from kornia_tidy.render.cost_model import Work
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

    def work(self, scene: LayeredScene) -> Work:
        """Return the work of the forward pass: pairs of tiles and layers, strips, samples.

        :mod:`kornia_tidy.render.cost_model` prices it.
        """
        ...

    def bounds(self, scene: LayeredScene) -> Iterator[Work]:
        """Yield lower bounds of :meth:`work`: one that takes no time, then closer ones that take less time than it."""
        ...

    def render(self, scene: LayeredScene) -> Tensor:
        """Return (B, C, h, w) light, without the stray light of gather and scatter.

        It has gradients with respect to image, layer weight, PSFs and, for occlusion, stray light; these can be
        differentiated in turn.
        """
        ...
