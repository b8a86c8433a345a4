"""Kernels in Triton against the dense backend, every gradient included, in Triton's interpreter or on a GPU."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import render
from tests.render.render_tester import RenderTester, render_by
from tests.render.scenes import Bank, make_bank, make_scene
from tests.rounding import gamma
from tests.triton_interpreter import DEVICE, needs_triton

COMPOSITINGS = ("gather", "scatter", "occlusion")


@needs_triton
class TestTritonBackend(RenderTester):
    @pytest.fixture
    def device(self):
        """Kernels run on a GPU, or on the CPU in the interpreter."""
        return DEVICE

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_equals_dense(self, compositing, border, layers, device):
        bank = make_bank(3, 2, 3, light=0.9, veil=True, device=device)
        image, defocus = make_scene(bank, 2, 9, 7)
        atol = 1e-9 if compositing == "occlusion" else 1e-13  # it divides round-off by as little as 1e-6
        self.assert_equals_dense("triton", image, defocus, bank, compositing, atol, border=border, layers=layers)

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("border", ["zero", "valid"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_gradcheck_equals_dense(self, compositing, border, layers, device):
        bank = make_bank(3, 2, 3, light=0.9, veil=True, device=device)
        image, defocus = make_scene(bank, 2, 5, 7)
        options = {"border": border, "layers": layers}
        self.assert_gradients_equal_dense("triton", image, defocus, bank, compositing, 1e-12, **options)

    def test_gradcheck_of_occlusion_equals_dense(self, device):
        bank = make_bank(3, 2, 3, light=0.9, veil=True, device=device)
        image, defocus = make_scene(bank, 1, 5, 7)
        options = {"border": "reflect", "layers": "linear"}
        self.assert_gradients_equal_dense("triton", image, defocus, bank, "occlusion", 1e-8, **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_cardinality_one_defocus_map_for_a_batch(self, compositing, device):
        bank = make_bank(3, 1, 3, device=device, veil=True)
        image, defocus = make_scene(bank, 2, 5, 7)
        options, atol = {"border": "reflect", "layers": "linear"}, 1e-8 if compositing == "occlusion" else 1e-12
        for check in (self.assert_equals_dense, self.assert_gradients_equal_dense):
            check("triton", image, defocus[:1], bank, compositing, atol, **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_cardinality_one_layer(self, compositing, device):
        bank = make_bank(1, 1, 3, device=device)
        image, defocus = make_scene(bank, 1, 5, 7)
        self.assert_equals_dense("triton", image, defocus, bank, compositing, 1e-12)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_float32_over_several_tiles(self, compositing, device):
        """Against float64: all that is added is positive, so each sum is off by gamma of itself at most.

        With occlusion each layer's quotient is off by two such sums, and what it lets through keeps that error.
        """
        bank = make_bank(3, 1, 5, light=1.0, device=device)
        image, defocus = make_scene(bank, 1, 11, 39)
        expected = render(image, defocus, bank, compositing, method="dense")
        small = bank.to(torch.float32)
        coded = render_by("triton", image.float(), defocus, Bank(small.psfs, bank.defocus), compositing)
        assert coded.dtype == torch.float32
        sums = 4 * len(bank.psfs) if compositing == "occlusion" else 1
        off = (coded.double() - expected).abs()
        # Blocked sums of 5 x 5 terms; PSFs, image and weights are rounded before.
        assert float((off / expected).max()) <= sums * gamma(2 * 5 + 8, torch.float32)
        assert float(off.square().mean().sqrt() / expected.square().mean().sqrt()) <= 1e-6

    def test_exception_negative_psfs_with_occlusion(self, device):
        bank = make_bank(3, 1, 3, device=device)
        bank.psfs[0, 0, 0, 0] = -0.1
        image, defocus = make_scene(bank, 1, 5, 7)
        with pytest.raises(ValueError, match=r"PSFs without negative values here, got one with -1\.0e-01"):
            render_by("triton", image, defocus, bank, "occlusion")

    def test_dynamo_is_one_operator_of_a_whole_graph(self, device):
        bank = make_bank(2, 1, 3, device=device)
        image, defocus = make_scene(bank, 1, 4, 5)

        def function(image):
            return render(image, defocus, bank, method="triton")

        compiled = torch.compile(function, fullgraph=True, backend="aot_eager")
        image = image.requires_grad_()
        self.assert_close(compiled(image), function(image), rtol=0, atol=0)
        (gradient,), (expected,) = (torch.autograd.grad(f(image).square().sum(), image) for f in (compiled, function))
        self.assert_close(gradient, expected, rtol=0, atol=0)


class TestRefusal(RenderTester):
    def test_exception_a_processor_without_the_interpreter(self, monkeypatch):
        monkeypatch.delenv("TRITON_INTERPRET", raising=False)
        bank = make_bank()
        message = "method 'triton' does not support this scene: Triton's kernels run on CUDA GPUs, and .* on 'cpu'"
        with pytest.raises(ValueError, match=message):
            render_by("triton", *make_scene(bank), bank)

    def test_exception_triton_is_not_installed(self, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
        bank = make_bank()
        with pytest.raises(ValueError, match=r"Triton is not installed: it comes with .*kornia-tidy\[triton\]"):
            render_by("triton", *make_scene(bank), bank)
