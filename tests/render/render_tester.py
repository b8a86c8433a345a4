"""What tests of the backends share: rendering by a backend, and comparisons with the dense one."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.render import render
from kornia_tidy.render.backend import Backend
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.dispatch import BACKENDS
from tests.base import BaseTester
from tests.render.scenes import Bank

METHODS = ("auto", "batched", "dense")  # those that support small scenes too
# Tiles so small, and chunks of so few of them, that a small scene has many of both.
SMALL_TILES = BatchedBackend(step=16, chunk_bytes=100_000)


def render_by(
    method: str | Backend, image: Tensor, defocus: Tensor, bank: Bank, compositing: str = "gather", **options
) -> Tensor:
    """Render by a backend, given itself or by its name."""
    if isinstance(method, str):
        return render(image, defocus, bank, compositing, method=method, **options)
    BACKENDS["given"] = method  # until the test ends, as gradients ask for it again
    return render(image, defocus, bank, compositing, method="given", **options)


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
