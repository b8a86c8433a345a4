"""What tests of the fast renderers share: comparisons with the dense one."""

from __future__ import annotations

import torch

from kornia_tidy.render.compositing import render
from tests.base import BaseTester
from tests.render.scenes import Bank


class RenderTester(BaseTester):
    def assert_equals_dense(self, image, defocus, bank, compositing, atol, **options) -> None:
        expected = render(image, defocus, bank, compositing, method="dense", **options)
        self.assert_close(render(image, defocus, bank, compositing, **options), expected, rtol=0, atol=atol)

    def assert_gradients_equal_dense(self, image, defocus, bank, compositing, atol, **options) -> None:
        """To image, defocus, PSFs and veil, within ``atol`` of the largest; nearest layers have none to defocus."""
        slopes = []
        for method in ("dense", "tiled"):
            inputs = [x.clone().requires_grad_() for x in (image, defocus, bank.psfs, bank.veil)]
            scene = Bank(inputs[2], bank.defocus, inputs[3])
            coded = render(inputs[0], inputs[1], scene, compositing, method=method, **options)
            slopes.append(torch.autograd.grad(coded.square().mean(), inputs, allow_unused=True))
        assert [expected is None for expected in slopes[0]] == [False, options["layers"] == "nearest", False, False]
        for expected, slope in zip(*slopes, strict=True):
            if expected is None:
                assert slope is None
            else:
                self.assert_close(slope, expected, rtol=0, atol=atol * float(expected.abs().max()))
