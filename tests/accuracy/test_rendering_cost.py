from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import forward_ad
from torch.utils.flop_counter import FlopCounterMode

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.accuracy.costs import bank_work, rendering_work, window_side
from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.overlap_ops import SOURCE
from kornia_tidy.render import layered_scene
from kornia_tidy.render.backend import transform_operations
from kornia_tidy.render.dispatch import choose
from tests.base import BaseTester

NODES = tuple(float(psi) for psi in range(-20, 21, 2))
COMPOSITING = ("gather", "scatter", "occlusion")
needs_compiler = pytest.mark.skipif(compiled(SOURCE, torch.float32) is None, reason="no C compiler compiles it here")


def ramp(height: int, width: int) -> torch.Tensor:
    return torch.linspace(-10, 10, height).view(1, 1, -1, 1).expand(1, 1, height, width)


class TestBank(BaseTester):
    @pytest.mark.parametrize("fidelity", [Fidelity(window=31), Fidelity(window=15, pixel_tolerance=1e-6, double=True)])
    def test_feature_matrix_products_are_those_that_torch_counts(self, fidelity):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=fidelity)
        # Forward-mode derivatives have the matrix products made in torch, where they are counted.
        with FlopCounterMode(display=False) as counter, forward_ad.dual_level():
            optics.psf_bank(3, None, (-5.0, 0.0, 5.0))
        counted = counter.get_total_flops()
        expected = bank_work(optics.psf_model, optics.spectrum, 2, fidelity, 3).operations / (
            2 if fidelity.double else 1
        )
        assert expected == pytest.approx(counted, rel=0.05)

    def test_exception_a_window_must_be_fixed(self):
        with pytest.raises(ValueError, match="needs a fixed window, got window=None of 'balanced'"):
            window_side(Fidelity())


class TestRenderingWork(BaseTester):
    @pytest.mark.parametrize("compositing", COMPOSITING)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["replicate", "valid"])
    def test_feature_it_is_what_the_backend_says_of_the_scene(self, compositing, layers, border):
        """The planner counts from defocus alone what the renderer counts from the scene."""
        psi, window, options = ramp(90, 120), 13, {"compositing": compositing, "layers": layers, "border": border}
        image, psfs = torch.rand(2, 3, 90, 120), torch.rand(len(NODES), 3, window, window)
        scene = layered_scene(image, psi, torch.tensor(NODES), psfs, **options)
        assert rendering_work(psi, 2, 3, NODES, window, **options) == choose(scene).work(scene)

    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_feature_it_is_counted_of_psfs_that_no_memory_would_hold(self, compositing):
        """Behind a very fast lens the layers of the reference are many, and large."""
        nodes = tuple(psi / 100 for psi in range(-100_000, 100_001))  # with 513 px some 600 GB
        assert rendering_work(ramp(90, 120), 1, 3, nodes, 513, compositing=compositing, border="zero").operations > 0

    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_feature_it_grows_with_channels_and_precision(self, compositing):
        def work(channels, **options):
            return rendering_work(ramp(256, 256), 1, channels, NODES, 41, compositing=compositing, **options)

        one, three, double = work(1), work(3), work(1, double=True)
        assert one.operations < three.operations <= 3 * one.operations * (1 + 1e-12)
        assert one.operations < double.operations <= 2.1 * one.operations
        assert one.memory < double.memory < 2.1 * one.memory
        assert one.memory < three.memory < 3.1 * one.memory

    @needs_compiler
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_feature_a_layer_in_every_window_takes_a_transform_of_each(self, compositing):
        """And one of its PSF; the products and sums of a transform are less than half of it."""
        options = {"layers": "nearest", "compositing": compositing, "border": "replicate"}
        stripes = 10 * (torch.arange(400) // 8 % 2).expand(1, 1, 300, 400).float()  # a sample sees every eighth pixel
        one, two = (rendering_work(psi, 1, 1, (0.0, 10.0), 31, **options) for psi in (0 * stripes, stripes))
        height, width = (300, 400) if compositing == "gather" else (330, 430)
        tile = one.window - 31 + 1
        windows = math.ceil(height / tile) * math.ceil(width / tile)
        more = (two.operations - one.operations) / transform_operations(one.window, one.window)
        assert windows + 1 <= more < 1.5 * (windows + 1)
