"""Gradients, memory and numeric types; the physics is in test_compositing, tiles in backends/test_batched."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING, render
from tests.base import BaseTester
from tests.render.render_tester import METHODS
from tests.render.scenes import Bank, make_bank, make_scene

over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)


class TestRenderNumerics(BaseTester):
    # Gradients

    @over_compositing
    @pytest.mark.parametrize("border", BORDERS)
    def test_gradcheck_of_the_dense_render(self, compositing, border, device):
        """Gradients of other backends are compared with these: backends/test_every_backend.py."""
        bank = make_bank(3, 2, 3, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 5, 6)
        middles = torch.tensor([-25.0, -17.0, -8.0, 3.0], device=device, dtype=torch.float64)  # away from the nodes
        defocus = middles[torch.randint(4, (2, 1, 5, 6), device=device)]
        if compositing == "occlusion":  # in noise divisors come near to nothing
            defocus = middles[(torch.arange(5)[:, None] // 3 + torch.arange(6) // 3) % 3].repeat(2, 1, 1, 1)

        def function(image, defocus, psfs, veil):
            return render(image, defocus, Bank(psfs, bank.defocus, veil), compositing, border=border, method="dense")

        self.gradcheck(function, (image, defocus, bank.psfs, bank.veil))

    @over_compositing
    @pytest.mark.parametrize("method", METHODS)
    def test_feature_defocus_exactly_on_a_node_has_the_gradient_above(self, compositing, method, device):
        """The next layer has no weight anywhere, and yet the gradient must see it."""
        bank = make_bank(3, 1, 3, device=device)
        image, _ = make_scene(bank, 1, 6, 6)
        step = 1e-6

        def total(defocus):
            ramp = torch.arange(36.0, device=device, dtype=torch.float64).view(1, 1, 6, 6)
            return (render(image, defocus, bank, compositing, method=method) * ramp).sum()

        defocus = torch.full((1, 1, 6, 6), -11.0, device=device, dtype=torch.float64, requires_grad=True)
        gradient = torch.autograd.grad(total(defocus), defocus)[0].sum()
        above = (total(defocus.detach() + step) - total(defocus.detach())) / step
        self.assert_close(gradient, above, rtol=1e-6, atol=1e-8)

    # Memory

    def test_feature_dense_gather_keeps_no_blurred_image_a_layer_for_the_gradients(self, device):
        """Bytes that autograd saves grow by one spectrum of a PSF and two masks a layer, not by the batch's light."""

        def saved_bytes(layers):
            bank = make_bank(layers, 1, 3, dtype=torch.float32, device=device)
            bank = replace(bank, psfs=bank.psfs.requires_grad_(), defocus=bank.defocus.detach())
            image = torch.rand(1, 1, 64, 64, device=device).expand(8, 1, 64, 64)
            span = bank.defocus[-1] - bank.defocus[0]
            defocus = bank.defocus[0] + span * torch.rand(1, 1, 64, 64, device=device)
            kept = {}

            def pack(tensor):
                kept[tensor.untyped_storage().data_ptr()] = (tensor.untyped_storage().nbytes(), tensor)
                return tensor

            with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
                render(image, defocus.requires_grad_(), bank, method="dense")
            return sum(size for size, _ in kept.values())

        blurred = 8 * 64 * 64 * 4
        assert saved_bytes(6) - saved_bytes(2) < 4 * blurred / 2

    # Numeric types

    @over_compositing
    def test_feature_defocus_does_not_pass_through_the_half_type_of_the_image(self, compositing, device):
        """A defocus of 2049.25 is not a float16 and would be 2048 there."""
        psfs = torch.tensor([0.0, 1.0], device=device).view(2, 1, 1, 1)
        bank = Bank(psfs, torch.tensor([2048.0, 2050.0], device=device))
        image = torch.ones(1, 1, 2, 2, device=device, dtype=torch.float16)
        coded = render(image, torch.full((1, 1, 2, 2), 2049.25, device=device), bank, compositing)
        self.assert_close(coded.float(), torch.full_like(coded, 0.625).float(), rtol=0, atol=1e-3)

    @over_compositing
    def test_feature_a_float64_bank_lifts_the_computation(self, compositing, device):
        bank = make_bank(4, 1, 5, dtype=torch.float64, device=device)
        image, defocus = make_scene(bank)
        image = image.float()
        coded = render(image, defocus, bank, compositing)
        assert coded.dtype == torch.float32
        assert torch.equal(coded, render(image.double(), defocus, bank, compositing).float())
