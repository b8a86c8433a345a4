"""The renderer as one operator of torch: compiled and exported graphs render by the same backends as eager code.

The operator assigns the layers, chooses the backend and renders when it runs: which layers a tile holds depends on
values, which a compiler does not know. Its gradient is a second operator, which makes the scene again: only the
arguments are kept between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.mode import Mode, recording_in_operator, torch_mode
from kornia_tidy.psf.field import Field
from kornia_tidy.render.backends.dense import differentiable_gradients
from kornia_tidy.render.dispatch import choose
from kornia_tidy.render.layers import check_nodes
from kornia_tidy.render.scene import assigned_scene, check_scene
from kornia_tidy.render.stray_light import stray_light_of

_SCENE = (
    "Tensor image, Tensor defocus, Tensor nodes, Tensor psfs, Tensor? stray_light, str compositing, str layers,"
    " str border, bool correlate, int[] field, str method"
)
COMPOSITINGS = ("gather", "scatter", "occlusion")
_TENSORS = 5  # of a scene, which may have gradients

torch.library.define("kornia_tidy::render_layers", f"({_SCENE}) -> Tensor")
torch.library.define("kornia_tidy::render_layers_gradients", f"({_SCENE}, Tensor gradient, bool[] wanted) -> Tensor[]")


@dataclass(frozen=True)
class Rendering:
    """How a scene is rendered.

    Args:
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        border: what lies beyond the image.
        layers: ``"nearest"`` or ``"linear"``: how pixels between two layers take part in them.
        correlate: whether PSFs are flipped by 180 degrees.
        method: the backend, see :func:`render_layers`.
    """

    compositing: str
    border: str
    layers: str = "linear"
    correlate: bool = False
    method: str = "auto"


def render_layers(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    stray_light: Tensor | None,
    *,
    compositing: str,
    layers: str,
    border: str,
    correlate: bool,
    method: str,
    field: Field | None = None,
) -> Tensor:
    """Render a scene by the backend that suits it, or by one that is named: operator ``kornia_tidy::render_layers``.

    Args:
        image: (B, C, H, W) linear light.
        defocus: as the other tensors and ``layers`` to ``correlate`` in
            :func:`kornia_tidy.render.scene.layered_scene`.
        nodes: as there.
        psfs: as there.
        stray_light: as there.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        layers: as there.
        border: as there.
        correlate: as there.
        method: ``"auto"`` or the name of a backend, see :func:`kornia_tidy.render.dispatch.choose`.
        field: where over the picture PSFs (F, D, C, P, P) are known; default: they are the same everywhere.

    Returns:
        (B, C, h, w) in the image's dtype, computed in float32 or better, autocast or not. It has gradients with respect
        to all tensors, which can be differentiated in turn.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit or a choice is not known, and as :func:`kornia_tidy.render.dispatch.choose`.
    """
    if compositing not in COMPOSITINGS:
        check_choice("compositing", compositing, COMPOSITINGS)
    check_scene(image, defocus, nodes, psfs if field is None else psfs[0], stray_light, border)
    mode = torch_mode()
    if nodes.device.type != "cpu" and Mode.UNREAD not in mode:
        check_nodes(nodes)
    render = _rendered if Mode.TRANSFORM in mode else torch.ops.kornia_tidy.render_layers
    tensors, over = (image, defocus, nodes, psfs, stray_light), numbers_of(field)
    return render(*tensors, compositing, layers, border, correlate, over, method)


def numbers_of(field: Field | None) -> list[int]:
    """Return a field as the renderer's operators take it."""
    return [] if field is None else [*field.size, *field.nodes, *field.origin, field.cell]


def _field(numbers: Sequence[int]) -> Field | None:
    if not numbers:
        return None
    rows, columns, down, across, top, left, cell = numbers
    return Field((rows, columns), (down, across), origin=(top, left), cell=cell)


def _rendered(*arguments: Any) -> Tensor:
    image, method = arguments[0], arguments[-1]
    if not len(image):
        return _render_fake(*arguments)
    with torch.autocast(image.device.type, enabled=False):
        scene = assigned_scene(*arguments[:-2], _field(arguments[-2]))
        light = choose(scene, method).render(scene)
        if scene.stray_light is not None and scene.compositing != "occlusion":
            light = light + stray_light_of(scene)
        return light.to(scene.dtype).contiguous()


def _render_fake(*arguments: Any) -> Tensor:
    image, psfs, border = arguments[0], arguments[3], arguments[7]
    lost = psfs.shape[-1] - 1 if border == "valid" else 0
    return image.new_empty(image.shape[0], image.shape[1], image.shape[2] - lost, image.shape[3] - lost)


def _gradients(*arguments: Any) -> list[Tensor]:
    tensors, options, (method, gradient, wanted) = arguments[:_TENSORS], arguments[_TENSORS:-3], arguments[-3:]
    if not len(gradient):
        return [torch.zeros_like(x) for x, want in zip(tensors, wanted, strict=True) if want and x is not None]
    given = zip(tensors, wanted, strict=True)
    own: list[Any] = [None if x is None else x.detach().requires_grad_(want) for x, want in given]
    leaves = [x for x in own if x is not None and x.requires_grad]
    with recording_in_operator(), torch.autocast(gradient.device.type, enabled=False):
        scene = assigned_scene(*own, *options[:-1], _field(options[-1]))
        pairs = choose(scene, method).gradients(scene, gradient.to(scene.image.dtype))
        if scene.stray_light is not None and scene.compositing != "occlusion":
            stray_light = stray_light_of(scene)
            if stray_light.requires_grad:
                pairs.append((stray_light, gradient.to(stray_light.dtype).sum_to_size(stray_light.shape)))
        found: Sequence[Tensor | None] = [None] * len(leaves)
        if pairs:
            made, gradients = zip(*pairs, strict=True)
            found = torch.autograd.grad(made, leaves, gradients, allow_unused=True)
    return [
        torch.zeros_like(leaf, memory_format=torch.contiguous_format) if x is None else x.contiguous()
        for x, leaf in zip(found, leaves, strict=True)
    ]


def _gradients_fake(*arguments: Any) -> list[Tensor]:
    pairs = zip(arguments[:_TENSORS], arguments[-1], strict=True)
    return [x.new_empty(x.shape) for x, want in pairs if want and x is not None]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:_TENSORS])
    ctx.options = inputs[_TENSORS:]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    tensors, options = ctx.saved_tensors, ctx.options[:-1]
    layered = options[1] == "linear" and len(tensors[2]) > 1  # otherwise nothing depends smoothly on defocus
    wanted = [
        bool(want and x is not None and (layered or n not in (1, 2)))
        for n, (x, want) in enumerate(zip(tensors, ctx.needs_input_grad, strict=False))
    ]
    rest = [None] * len(ctx.options)
    if torch.is_grad_enabled():  # it is differentiated in turn

        def render(*tensors: Any) -> Tensor:
            return _rendered(*tensors, *options, "dense")

        with torch.autocast(gradient.device.type, enabled=False):
            return *differentiable_gradients(render, tensors, gradient, wanted), *rest
    found = iter(
        torch.ops.kornia_tidy.render_layers_gradients(*tensors, *ctx.options, gradient, wanted) if any(wanted) else ()
    )
    return *(next(found) if want else None for want in wanted), *rest


torch.library.impl("kornia_tidy::render_layers", "default", torch.no_grad()(_rendered))
torch.library.register_fake("kornia_tidy::render_layers", _render_fake)
torch.library.register_autograd("kornia_tidy::render_layers", _backward, setup_context=_keep)
torch.library.impl("kornia_tidy::render_layers_gradients", "default", _gradients)
torch.library.register_fake("kornia_tidy::render_layers_gradients", _gradients_fake)
