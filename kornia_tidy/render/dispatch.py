"""The renderer: one operator of torch, which hands a layered scene to the backend that suits it.

Compiled and exported graphs render by the same backends as eager code. The operator assigns the layers, chooses the
backend and renders when it runs: which layers a tile holds depends on values, which a compiler does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.kernels.recomputed_ops import define_recomputed
from kornia_tidy.mode import Mode, refuse_onnx, torch_mode
from kornia_tidy.psf.field import Field
from kornia_tidy.render.backend import Backend, GradientPairs, Work, wants_gradient
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.backends.compiled import CompiledBackend
from kornia_tidy.render.backends.dense import DenseBackend
from kornia_tidy.render.scene import LayeredScene, check_nodes, layered_scene
from kornia_tidy.render.stray_light import stray_light_of

COMPOSITINGS = ("gather", "scatter", "occlusion")

BACKENDS: dict[str, Backend] = {
    backend.name: backend for backend in (DenseBackend(), CompiledBackend(), BatchedBackend())
}
# Where dense is the faster one: occlusion in C takes P^2 operations a pixel, and tiles of a small image through large
# PSFs are as large as it. It is taken while an image with all channels has few bytes in float64.
LARGEST_OCCLUSION, LARGEST_SHARE, LARGEST_PLANE = 65, 1 / 4, 32 << 20


@dataclass(frozen=True)
class Rendering:
    """How a scene is rendered.

    Args:
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        border: continuation of the image beyond its edges.
        layers: ``"nearest"`` or ``"linear"``: how pixels between two layers take part in them.
        correlate: whether PSFs are flipped by 180 degrees.
    """

    compositing: str
    border: str
    layers: str = "linear"
    correlate: bool = False


def render_layers(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    stray_light: Tensor | None,
    rendering: Rendering,
    method: str = "auto",
    field: Field | None = None,
) -> Tensor:
    """Render a scene by the backend that suits it, or by one that is named: operator ``kornia_tidy::render_layers``.

    Args:
        image: (B, C, H, W) linear light.
        defocus: as the other tensors in :func:`kornia_tidy.render.scene.layered_scene`.
        nodes: as there.
        psfs: as there.
        stray_light: as there.
        rendering: how.
        method: ``"auto"`` or the name of a backend, see :func:`choose`.
        field: where over the picture PSFs (F, D, C, P, P) are known; default: they are the same everywhere.

    Returns:
        (B, C, h, w) in the image's dtype, computed in float32 or better, autocast or not. It has gradients with respect
        to all tensors, which can be differentiated in turn.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit or a choice is not known, and as :func:`choose`.
    """
    if rendering.compositing not in COMPOSITINGS:
        check_choice("compositing", rendering.compositing, COMPOSITINGS)
    mode = torch_mode()
    if nodes.device.type != "cpu" and Mode.UNREAD not in mode:
        check_nodes(nodes)
    if rendering.layers == "nearest" or len(nodes) == 1:  # nothing depends smoothly on defocus
        defocus, nodes = defocus.detach(), nodes.detach()
    render = _rendered if Mode.TRANSFORM in mode else torch.ops.kornia_tidy.render_layers
    how = rendering.compositing, rendering.layers, rendering.border, rendering.correlate
    over = [] if field is None else [*field.size, *field.nodes, *field.origin, field.cell, field.still]
    return render(image, defocus, nodes, psfs, stray_light, *how, over, method)


def choose(scene: LayeredScene, method: str = "auto") -> Backend:
    """Return the backend that renders a scene.

    Transforms of torch work only with dense. Accelerators take batched. Processors take compiled, and batched without a
    compiler; large PSFs go densely where that is faster, while the planes are small and no gradients are wanted, for
    which dense keeps every spectrum.

    Args:
        scene: to be rendered.
        method: ``"auto"``, or the name of the backend.

    Raises:
        ValueError: if the method is not known, or does not support the scene.
    """
    if method != "auto":
        check_choice("method", method, ("auto", *BACKENDS))
        if (why := refusal(BACKENDS[method], scene)) is not None:
            raise ValueError(f"method {method!r} does not support this scene: {why}; method='auto' takes one that does")
        return BACKENDS[method]
    if Mode.TRANSFORM in torch_mode():
        return BACKENDS["dense"]
    if scene.image.device.type != "cpu":
        return BACKENDS["batched"]
    side = scene.psfs.shape[-1]
    if BACKENDS["compiled"].refusal(scene) is None:
        large_psfs = scene.compositing == "occlusion" and side > LARGEST_OCCLUSION
        name, large = "compiled", large_psfs and scene.field is None
    else:
        name, large = "batched", side >= LARGEST_SHARE * min(scene.output_size)
    return BACKENDS["dense" if large and _keeps_little(scene) else name]


def _keeps_little(scene: LayeredScene) -> bool:
    """Return whether dense rendering takes little memory: for gradients it keeps a spectrum of each layer."""
    inputs = scene.image, scene.layer_weight, scene.psfs, scene.stray_light
    recorded = torch.is_grad_enabled() and any(wants_gradient(x) for x in inputs)
    return not recorded and 8 * scene.image.numel() <= LARGEST_PLANE


def refusal(backend: Backend, scene: LayeredScene) -> str | None:
    """Return why a backend does not support a scene, or None if it does."""
    if backend.name != "dense" and Mode.TRANSFORM in torch_mode():
        return "torch.func and forward-mode derivatives need plain operations of torch"
    return backend.refusal(scene)


@dataclass(frozen=True)
class Explanation:
    """The backend that renders a scene, and the work of the others, see :func:`explain`.

    Args:
        scene: the scene in words.
        backend: name of the one that ``method="auto"`` takes.
        works: work of each backend that supports the scene, by name.
        objections: why a backend does not support the scene, by name.
    """

    scene: str
    backend: str
    works: dict[str, Work]
    objections: dict[str, str]

    def __str__(self) -> str:
        first = sorted(self.works, key=lambda name: name != self.backend)
        words = {name: str(self.works[name]) for name in first} | self.objections
        return "\n".join([f"{self.scene}: {self.backend}", *(f"  {name}: {why}" for name, why in words.items())])


def explain(scene: LayeredScene) -> Explanation:
    """Return the choice of ``method="auto"`` for a scene, with the work of each backend or why it does not do it.

    Args:
        scene: from :func:`kornia_tidy.render.scene.layered_scene`.

    Example:
        >>> import torch
        >>> from kornia_tidy.render.scene import layered_scene
        >>> image, psi, nodes = torch.rand(1, 3, 64, 64), torch.zeros(1, 1, 64, 64), torch.tensor([0.0, 4.0])
        >>> print(explain(layered_scene(image, psi, nodes, torch.rand(2, 3, 23, 23))))  # doctest: +ELLIPSIS
        gather of 1 x 3 channels of 64x64 px, 1 of 2 layers, PSFs of 23x23 px: ...
    """
    (height, width), (batch, channels), side = scene.output_size, scene.image.shape[:2], scene.psfs.shape[-1]
    words = (
        f"{scene.compositing} of {batch} x {channels} channels of {height}x{width} px, {scene.sampled_layers} of "
        f"{scene.psfs.shape[-4]} layers, PSFs of {side}x{side} px"
    )
    if scene.field is not None:
        words += f" at {scene.field.nodes[0]}x{scene.field.nodes[1]} places over the picture"
    objections = {name: why for name, backend in BACKENDS.items() if (why := refusal(backend, scene)) is not None}
    works = {name: backend.work(scene) for name, backend in BACKENDS.items() if name not in objections}
    return Explanation(words, choose(scene).name, works, objections)


# ---------------------------------------------------------------------- the operator


_SCENE = (
    "Tensor image, Tensor defocus, Tensor nodes, Tensor psfs, Tensor? stray_light, str compositing, str layers,"
    " str border, bool correlate, int[] field, str method"
)


def _field(numbers: Sequence[int]) -> Field:
    rows, columns, down, across, top, left, cell, still = numbers
    return Field((rows, columns), (down, across), origin=(top, left), cell=cell, still=still)


def _rendered(*arguments: Any) -> Tensor:
    image, (*given, over, method) = arguments[0], arguments
    with torch.autocast(image.device.type, enabled=False):
        scene = layered_scene(*given, _field(over) if over else None)
        if not len(image):
            return _render_fake(*arguments)
        light = choose(scene, method).render(scene)
        if scene.stray_light is not None and scene.compositing != "occlusion":
            light = light + stray_light_of(scene)
        return light.to(scene.dtype).contiguous()


def _render_fake(*arguments: Any) -> Tensor:
    refuse_onnx()
    image, psfs, border = arguments[0], arguments[3], arguments[7]
    lost = psfs.shape[-1] - 1 if border == "valid" else 0
    return image.new_empty(image.shape[0], image.shape[1], image.shape[2] - lost, image.shape[3] - lost)


def _pairs(*arguments: Any) -> GradientPairs:
    *given, over, method, gradient = arguments
    if not len(gradient):
        return []
    scene = layered_scene(*given, _field(over) if over else None)
    pairs = choose(scene, method).gradients(scene, gradient.to(scene.image.dtype))
    if scene.stray_light is not None and scene.compositing != "occlusion":
        stray_light = stray_light_of(scene)
        if stray_light.requires_grad:
            pairs.append((stray_light, gradient.to(stray_light.dtype).sum_to_size(stray_light.shape)))
    return pairs


def _densely(*arguments: Any) -> Tensor:
    return _rendered(*arguments[:-1], "dense")


define_recomputed("render_layers", _SCENE, 5, torch.no_grad()(_rendered), _render_fake, _pairs, _densely)
