"""The choice of a backend: the cheapest one that supports a scene, or the one asked for by name."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.render.backend import Backend, GradientPairs
from kornia_tidy.render.backends.batched import MOST_SAMPLES, BatchedBackend
from kornia_tidy.render.backends.dense import DenseBackend, differentiable_gradients
from kornia_tidy.render.backends.direct import DirectBackend
from kornia_tidy.render.backends.overlap import OverlapBackend
from kornia_tidy.render.backends.tiled import TiledBackend
from kornia_tidy.render.cost_model import seconds_of
from kornia_tidy.render.cost_profile import EPYC
from kornia_tidy.render.scene import SAMPLE, LayeredScene, scene_of_layers
from kornia_tidy.render.stray_light import stray_light_of
from kornia_tidy.runtime.tracing import is_transformed

BACKENDS: dict[str, Backend] = {
    backend.name: backend for backend in (DirectBackend(), OverlapBackend(), TiledBackend(), DenseBackend())
}
BATCHED = BatchedBackend()  # for accelerators; "auto" takes it there without an estimate
NAMED: dict[str, Backend] = {**BACKENDS, BATCHED.name: BATCHED}
METHODS = ("auto", *NAMED)
LARGEST_PLANE = 32 << 20  # bytes of an image with all channels; "auto" does not take dense for larger ones
REMEMBERED = 256  # choices, each of some 500 bytes and a grid

_choices: dict[tuple[Hashable, ...], tuple[Backend, dict[Any, Any]]] = {}


def render_scene(scene: LayeredScene, method: str | Backend = "auto") -> Tensor:
    """Render a layered scene by the cheapest backend, or by one that is named or given.

    Args:
        scene: from :func:`kornia_tidy.render.scene.layered_scene`.
        method: ``"auto"``, ``"direct"``, ``"overlap"``, ``"tiled"``, ``"dense"`` or ``"batched"``, or a backend.

    Returns:
        (B, C, h, w) light in the scene's dtype, computed in float32 or better, whatever autocast says. It has gradients
        with respect to image, layer weight, PSFs and stray light. The backend makes them; those that are differentiated
        in turn are made by the dense one.

    Raises:
        ValueError: if the method is not known, or does not support the scene.
    """
    backend = choose(scene, method) if isinstance(method, str) else method
    if is_transformed():
        return render_unrecorded(backend, scene)
    return _Rendered.apply(backend, scene, scene.image, scene.layer_weight, scene.psfs, scene.stray_light)


def render_unrecorded(backend: Backend, scene: LayeredScene) -> Tensor:
    """Render a layered scene without the gradients that backends make."""
    with torch.autocast(scene.image.device.type, enabled=False):
        coded = backend.render(scene)
        if scene.stray_light is not None and scene.compositing != "occlusion":
            coded = coded + stray_light_of(scene)
    return coded.to(scene.dtype)


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
        (gradient,), wanted, given = grad_outputs, ctx.needs_input_grad[2:], ctx.scene

        def scene_of(*tensors: Any) -> LayeredScene:
            image, weight, psfs, stray_light = tensors
            rest = given.border, given.compositing, given.dtype
            return scene_of_layers(image, given.layer_index, weight, psfs, stray_light, *rest)

        if torch.is_grad_enabled():  # it is differentiated in turn

            def render(*tensors: Tensor | None) -> Tensor:
                return render_unrecorded(BACKENDS["dense"], scene_of(*tensors))

            return None, None, *differentiable_gradients(render, ctx.saved_tensors, gradient, wanted)
        own = leaves_of(ctx.saved_tensors, wanted)
        leaves = [x for x in own if x is not None and x.requires_grad]
        with torch.enable_grad():
            found = iter(chain_gradients(scene_gradients(ctx.backend, scene_of(*own), gradient), leaves))
        return None, None, *(next(found) if x is not None and x.requires_grad else None for x in own)


def leaves_of(tensors: Sequence[Tensor | None], wanted: Sequence[bool]) -> list[Tensor | None]:
    """Return tensors in which gradients end, that require them where they are wanted."""
    return [None if x is None else x.detach().requires_grad_(want) for x, want in zip(tensors, wanted, strict=True)]


def choose(scene: LayeredScene, method: str = "auto") -> Backend:
    """Return the backend that :func:`render_scene` takes.

    Of those that support the scene it is the one with the least estimated time. Dense rendering is taken only while
    its memory stays small, or if nothing else supports the scene. The choice for a sample of layers is remembered: it
    takes as long as to render a small image.

    Args:
        scene: to be rendered.
        method: ``"auto"``, or the name of the backend.

    Raises:
        ValueError: as :func:`render_scene`.
    """
    if method != "auto":
        check_choice("method", method, METHODS)
        backend = NAMED[method]
        why = refusal(backend, scene)
        if why is not None:
            raise ValueError(f"method {method!r} does not support this scene: {why}; method='auto' takes one that does")
        return backend
    accelerated = scene.image.device.type != "cpu"
    if accelerated and not is_transformed() and BATCHED.samples(scene) <= MOST_SAMPLES:
        return BATCHED
    # With occlusion the values of PSFs matter too.
    layout = {} if scene.layout is None or scene.compositing == "occlusion" else scene.layout
    if "fingerprint" not in layout:
        layout["fingerprint"] = _fingerprint(scene)
    key = layout["fingerprint"]
    known = None if key is None else _choices.get(key)  # another thread may empty the memory meanwhile
    if known is not None and (known[0].name != "direct" or known[0].refusal(scene) is None):  # others refuse nothing
        best, grids = known
        scene.grids.update(grids)
        return best
    able = [backend for backend in BACKENDS.values() if refusal(backend, scene) is None]
    if len(able) > 1 and memory_objection(scene) is not None:
        able.remove(BACKENDS["dense"])
    best = able[0] if key is None and len(able) == 1 else _fastest(able, scene)  # and its tiles, to be remembered
    if key is not None:
        if len(_choices) >= REMEMBERED:
            _choices.clear()
        _choices[key] = best, dict(scene.grids)
    return best


def _fastest(able: list[Backend], scene: LayeredScene) -> Backend:
    """Return the backend with the least estimated time. To count takes time: what cannot be faster is not counted."""
    best, least, profile, threads = able[0], math.inf, EPYC, torch.get_num_threads()
    bounds = {backend.name: backend.bounds(scene) for backend in able}
    first = {name: seconds_of(next(own), profile, threads) for name, own in bounds.items()}
    for backend in sorted(able, key=lambda backend: first[backend.name]):
        closer = (seconds_of(work, profile, threads) for work in bounds[backend.name])
        if first[backend.name] >= least or any(seconds >= least for seconds in closer):
            continue
        if (seconds := seconds_of(backend.work(scene), profile, threads)) < least:
            best, least = backend, seconds
    return best


def _fingerprint(scene: LayeredScene) -> tuple[Hashable, ...] | None:
    """Return what a choice depends on, with a digest of the sample of layers that costs are estimated from.

    None on an accelerator, which one would have to wait for, and where torch transforms the renderer.
    """
    labels = scene.labels
    if labels.layer_index.device.type != "cpu" or is_transformed():
        return None
    digest = hashlib.blake2b(digest_size=16)
    for layer in labels.terms(slice(None), *(slice(None, None, SAMPLE),) * 2):
        digest.update(layer.contiguous().numpy())
    refused = scene.compositing == "occlusion" and refusal(BACKENDS["direct"], scene)
    inputs = scene.image, scene.layer_weight, scene.psfs, scene.stray_light
    recorded = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)
    threads, shape = torch.get_num_threads(), labels.layer_index.shape
    shapes = scene.image.shape, scene.image.dtype, scene.psfs.shape, shape, labels.weight_gradient
    return scene.compositing, *shapes, refused, recorded, threads, digest.digest()


def refusal(backend: Backend, scene: LayeredScene) -> str | None:
    """Return why a backend does not support a scene, or None if it does."""
    if backend.name != "dense" and is_transformed():
        return "torch.func and forward-mode derivatives need plain operations of torch"
    return backend.refusal(scene)


def memory_objection(scene: LayeredScene) -> str | None:
    """Return why the memory of dense rendering is too large for a scene, or None if it is small."""
    inputs = scene.image, scene.layer_weight, scene.psfs, scene.stray_light
    if torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs):
        return "for gradients it keeps a spectrum for each layer"
    itemsize = 8 if scene.compositing == "occlusion" else scene.image.element_size()
    plane = scene.image.numel() * itemsize
    return f"a dozen planes of {plane >> 20} MiB would exist at a time" if plane > LARGEST_PLANE else None


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
        by_time = sorted(self.seconds.items(), key=lambda item: item[1])
        words = {name: f"about {1e3 * seconds:.3g} ms" for name, seconds in by_time}
        for name, why in self.objections.items():
            words[name] = f"{words[name]}, but {why}" if name in words else why
        return "\n".join([f"{self.scene}: {self.backend}", *(f"  {name}: {why}" for name, why in words.items())])


def explain(scene: LayeredScene) -> Explanation:
    """Return the choice of ``method="auto"`` for a scene, with the estimated times and the objections to the others.

    Args:
        scene: from :func:`kornia_tidy.render.scene.layered_scene`.

    Example:
        >>> import torch
        >>> from kornia_tidy.render.scene import layered_scene
        >>> image, psi, nodes = torch.rand(1, 3, 2, 40), torch.zeros(1, 1, 2, 40), torch.tensor([0.0, 4.0])
        >>> explanation = explain(layered_scene(image, psi, nodes, torch.rand(2, 3, 3, 3), compositing="scatter"))
        >>> sorted(explanation.seconds), explanation.objections
        (['dense', 'overlap', 'tiled'], {'direct': 'direct convolution gathers light and does not scatter it'})
    """
    (height, width), (batch, channels), side = scene.output_size, scene.image.shape[:2], scene.psfs.shape[-1]
    words = (
        f"{scene.compositing} of {batch} x {channels} channels of {height}x{width} px, {scene.sampled_layers} of "
        f"{len(scene.psfs)} layers, PSFs of {side}x{side} px, {torch.get_num_threads()} threads"
    )
    objections = {name: why for name, backend in BACKENDS.items() if (why := refusal(backend, scene)) is not None}
    profile, threads = EPYC, torch.get_num_threads()
    able = {name: backend for name, backend in BACKENDS.items() if name not in objections}
    seconds = {name: seconds_of(backend.work(scene), profile, threads) for name, backend in able.items()}
    if len(seconds) > 1 and (why := memory_objection(scene)) is not None:
        objections["dense"] = why
    return Explanation(words, choose(scene).name, seconds, objections)
