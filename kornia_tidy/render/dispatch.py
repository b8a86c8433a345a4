"""The choice of a backend: the cheapest one that supports a scene, or the one asked for by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.render.backend import Backend, GradientPairs
from kornia_tidy.render.backends.dense import DenseBackend, differentiable_gradients, memory_objection
from kornia_tidy.render.backends.direct import DirectBackend
from kornia_tidy.render.backends.tiled import TiledBackend
from kornia_tidy.render.scene import LayeredScene
from kornia_tidy.render.stray_light import stray_light_of
from kornia_tidy.runtime.tracing import is_transformed

BACKENDS: dict[str, Backend] = {backend.name: backend for backend in (DirectBackend(), TiledBackend(), DenseBackend())}
METHODS = ("auto", *BACKENDS)


def render_scene(scene: LayeredScene, method: str = "auto") -> Tensor:
    """Render a layered scene by the cheapest backend, or by one that is named.

    Args:
        scene: from :func:`kornia_tidy.render.scene.layered_scene`.
        method: ``"auto"``, ``"direct"``, ``"tiled"`` or ``"dense"``.

    Returns:
        (B, C, h, w) light in the scene's dtype.

    Raises:
        ValueError: if the method is not known, or does not support the scene.
    """
    return render_with(choose(scene, method), scene)


def render_with(backend: Backend, scene: LayeredScene) -> Tensor:
    """Render a layered scene by a backend, with its stray light.

    The result has gradients with respect to image, layer weight, PSFs and stray light. The backend makes them, for
    gradients that are differentiated in turn the dense one.
    """
    if is_transformed():
        return render_unrecorded(backend, scene)
    return _Rendered.apply(backend, scene, scene.image, scene.layer_weight, scene.psfs, scene.stray_light)


def render_unrecorded(backend: Backend, scene: LayeredScene) -> Tensor:
    """Return what :func:`render_with` returns, with those gradients only that torch makes of the backend's operations."""
    coded = backend.render(scene)
    if scene.stray_light is None or scene.compositing == "occlusion":
        return coded
    return coded + stray_light_of(scene)


@torch.enable_grad()
def scene_gradients(backend: Backend, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
    """Return the gradients of tensors that were made of the scene's, where they require gradients.

    Args:
        backend: makes them.
        scene: tensors that autograd records.
        gradient: (B, C, h, w) gradient of the rendered light.
    """
    pairs = backend.gradients(scene, gradient.to(scene.image.dtype))
    if scene.stray_light is not None and scene.compositing != "occlusion":
        stray_light = stray_light_of(scene)
        if stray_light.requires_grad:
            pairs.append((stray_light, gradient.to(stray_light.dtype).sum_to_size(stray_light.shape)))
    return pairs


def chain_gradients(pairs: GradientPairs, leaves: list[Tensor]) -> list[Tensor | None]:
    """Return the gradients of leaves from those of tensors that were made of them.

    Args:
        pairs: from :func:`scene_gradients`.
        leaves: tensors that the scene was made of; each has its gradient, or None.
    """
    if not pairs or not leaves:
        return [None] * len(leaves)
    tensors, gradients = zip(*pairs, strict=True)
    return list(torch.autograd.grad(tensors, leaves, gradients, allow_unused=True))


class _Rendered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, backend: Backend, scene: LayeredScene, *tensors: Tensor | None) -> Tensor:
        ctx.backend, ctx.scene = backend, scene
        ctx.save_for_backward(*tensors)
        return render_unrecorded(backend, scene)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,), wanted = grad_outputs, ctx.needs_input_grad[2:]

        def scene_of(*tensors: Tensor | None) -> LayeredScene:
            image, weight, psfs, stray_light = tensors
            return replace(ctx.scene, image=image, layer_weight=weight, psfs=psfs, stray_light=stray_light, found={})

        if torch.is_grad_enabled():  # it is differentiated in turn

            def render(*tensors: Tensor | None) -> Tensor:
                return render_unrecorded(BACKENDS["dense"], scene_of(*tensors))

            return None, None, *differentiable_gradients(render, ctx.saved_tensors, gradient, wanted)
        own = [
            None if x is None else x.detach().requires_grad_(want)
            for x, want in zip(ctx.saved_tensors, wanted, strict=True)
        ]
        leaves = [x for x in own if x is not None and x.requires_grad]
        found = iter(chain_gradients(scene_gradients(ctx.backend, scene_of(*own), gradient), leaves))
        return None, None, *(next(found) if x is not None and x.requires_grad else None for x in own)


def choose(scene: LayeredScene, method: str = "auto") -> Backend:
    """Return the backend that :func:`render_scene` takes.

    Of those that support the scene it is the one with the least estimated time. Dense rendering is taken only while
    its memory stays small, or if nothing else supports the scene.

    Args:
        scene: to be rendered.
        method: ``"auto"``, or the name of the backend.

    Raises:
        ValueError: as :func:`render_scene`.
    """
    check_choice("method", method, METHODS)
    if method != "auto":
        why = refusal(BACKENDS[method], scene)
        if why is not None:
            raise ValueError(f"method {method!r} does not support this scene: {why}; method='auto' takes one that does")
        return BACKENDS[method]
    able = [backend for backend in BACKENDS.values() if refusal(backend, scene) is None]
    if len(able) > 1 and memory_objection(scene) is not None:
        able.remove(BACKENDS["dense"])
    best, least = able[0], math.inf
    for backend in able if len(able) > 1 else ():
        if backend.least_seconds(scene) < least and (seconds := backend.seconds(scene)) < least:
            best, least = backend, seconds
    return best


def refusal(backend: Backend, scene: LayeredScene) -> str | None:
    """Return why a backend does not support a scene, or None if it does."""
    if backend.name != "dense" and is_transformed():
        return "torch.func and forward-mode derivatives need plain operations of torch"
    return backend.refusal(scene)


@dataclass(frozen=True)
class Explanation:
    """Which backend renders a scene and why, see :func:`explain`.

    Args:
        scene: the scene in words.
        backend: name of the one that ``method="auto"`` takes.
        seconds: estimated time of each backend that supports the scene, by name.
        objections: why a backend does not support the scene, or is not taken for its memory, by name.
    """

    scene: str
    backend: str
    seconds: dict[str, float]
    objections: dict[str, str]

    def __str__(self) -> str:
        words = {
            name: f"about {1e3 * self.seconds[name]:.3g} ms" for name in sorted(self.seconds, key=self.seconds.get)
        }
        for name, why in self.objections.items():
            words[name] = f"{words[name]}, but {why}" if name in words else why
        return "\n".join([f"{self.scene}: {self.backend}", *(f"  {name}: {why}" for name, why in words.items())])


def explain(scene: LayeredScene) -> Explanation:
    """Return which backend ``method="auto"`` takes for a scene, what each would cost and why others are not taken.

    Args:
        scene: from :func:`kornia_tidy.render.scene.layered_scene`.

    Example:
        >>> import torch
        >>> from kornia_tidy.render.scene import layered_scene
        >>> image, psi, nodes = torch.rand(1, 3, 2, 40), torch.zeros(1, 1, 2, 40), torch.tensor([0.0, 4.0])
        >>> explanation = explain(layered_scene(image, psi, nodes, torch.rand(2, 3, 3, 3), compositing="scatter"))
        >>> sorted(explanation.seconds), explanation.objections
        (['dense', 'tiled'], {'direct': 'direct convolution gathers light and does not scatter it'})
    """
    (height, width), (batch, channels) = scene.output_size, scene.image.shape[:2]
    words = (
        f"{scene.compositing} of {batch} x {channels} channels of {height}x{width} px, {scene.sampled_layers} of "
        f"{len(scene.psfs)} layers, PSFs of {scene.psf_size}x{scene.psf_size} px, {torch.get_num_threads()} threads"
    )
    objections = {name: why for name, backend in BACKENDS.items() if (why := refusal(backend, scene)) is not None}
    seconds = {name: backend.seconds(scene) for name, backend in BACKENDS.items() if name not in objections}
    if len(seconds) > 1 and (why := memory_objection(scene)) is not None:
        objections["dense"] = why
    return Explanation(words, choose(scene).name, seconds, objections)
