"""What tests of the backends share: rendering by a backend, and comparisons with the dense one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.render.backend import Backend
from kornia_tidy.render.backends.dense import DenseBackend, differentiable_gradients
from kornia_tidy.render.backends.tile_plan import BLOCKS, WINDOWS
from kornia_tidy.render.backends.tiled import TiledBackend
from kornia_tidy.render.compositing import render
from kornia_tidy.render.dispatch import chain_gradients, leaves_of, render_unrecorded, scene_gradients
from kornia_tidy.render.scene import LayeredScene, layered_scene, scene_of_layers
from tests.base import BaseTester
from tests.render.scenes import Bank

METHODS = ("auto", "tiled", "dense")  # those that support small scenes too
SMALL = {"chunk_bytes": 40_000, "accelerator_bytes": 40_000}
# Tiles so small, and chunks of so few of them, that a small scene has many of both.
SMALL_TILES = TiledBackend(
    replace(BLOCKS, sizes=(8, 12, 16), **SMALL),
    replace(WINDOWS, sizes=(8, 12, 16), **SMALL),
)


def render_by(
    method: str | Backend, image: Tensor, defocus: Tensor, bank: Bank, compositing: str = "gather", **options
) -> Tensor:
    """Render by a backend, given itself or by its name."""
    if isinstance(method, str):
        return render(image, defocus, bank, compositing, method=method, **options)
    scene = layered_scene(image, defocus, bank.defocus, bank.psfs, bank.veil, compositing=compositing, **options)
    return _Rendered.apply(method, scene, scene.image, scene.layer_weight, scene.psfs, scene.stray_light)


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
                return render_unrecorded(DenseBackend(), scene_of(*tensors))

            return None, None, *differentiable_gradients(render, ctx.saved_tensors, gradient, wanted)
        own = leaves_of(ctx.saved_tensors, wanted)
        leaves = [x for x in own if x is not None and x.requires_grad]
        with torch.enable_grad():
            found = iter(chain_gradients(scene_gradients(ctx.backend, scene_of(*own), gradient), leaves))
        return None, None, *(next(found) if x is not None and x.requires_grad else None for x in own)


class RenderTester(BaseTester):
    def assert_equals_dense(self, method, image, defocus, bank, compositing, atol, **options) -> None:
        expected = render(image, defocus, bank, compositing, method="dense", **options)
        self.assert_close(render_by(method, image, defocus, bank, compositing, **options), expected, rtol=0, atol=atol)

    def assert_gradients_equal_dense(self, method, image, defocus, bank, compositing, atol, **options) -> None:
        """To image, defocus, PSFs and veil, within ``atol`` of the largest; nearest layers have none to defocus."""
        gradients = []
        for way in ("dense", method):
            inputs = [x.clone().requires_grad_() for x in (image, defocus, bank.psfs, bank.veil)]
            scene = Bank(inputs[2], bank.defocus, inputs[3])
            coded = render_by(way, inputs[0], inputs[1], scene, compositing, **options)
            gradients.append(torch.autograd.grad(coded.square().mean(), inputs, allow_unused=True))
        assert [expected is None for expected in gradients[0]] == [False, options["layers"] == "nearest", False, False]
        for expected, gradient in zip(*gradients, strict=True):
            if expected is None:
                assert gradient is None
            else:
                self.assert_close(gradient, expected, rtol=0, atol=atol * float(expected.abs().max()))
