"""Rendering in C against the dense renderer, however labels lie, and which scenes it refuses."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.occlusion_ops import SOURCE, occlusion_direct
from kornia_tidy.kernels.overlap_ops import window_size
from kornia_tidy.kernels.window_sides import is_window_size
from kornia_tidy.render import layered_scene
from kornia_tidy.render.compositing import COMPOSITING, occlusion, render
from kornia_tidy.render.dispatch import choose
from tests.base import BaseTester
from tests.render.render_tester import RenderTester
from tests.render.scenes import Bank, hard_depth, make_bank, make_scene

needs_compiler = pytest.mark.skipif(compiled(SOURCE, torch.float32) is None, reason="no C compiler compiles it here")


@pytest.fixture(autouse=True)
def _on_a_processor(request):
    if "device" in request.fixturenames and torch.device(request.getfixturevalue("device")).type != "cpu":
        pytest.skip("it is for processors")


@needs_compiler
class TestCompiledRender(RenderTester):
    @needs_compiler
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    def test_feature_gradients_of_psfs_alone_through_occlusion(self, layers, border, device, dtype):
        """And of stray light. They go another way than with those of image and depth, and make no tiles."""
        bank = make_bank(5, 2, 7, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 31, 46)
        defocus = hard_depth("squares", bank, 31, 46) + 0.5
        gradients = []
        for method in ("dense", "compiled"):
            leaves = bank.psfs.clone().requires_grad_(), bank.veil.clone().requires_grad_()
            coded = occlusion(image, defocus, bank.defocus, *leaves, layers=layers, border=border, method=method)
            gradients.append(torch.autograd.grad(coded.square().mean(), leaves))
        for expected, found in zip(*gradients, strict=True):
            atol = (2e-5 if dtype == torch.float32 else 1e-10) * float(expected.abs().max())
            self.assert_close(found, expected, rtol=0, atol=atol)

    def test_feature_rows_of_any_stride(self, device):
        """Images and maps that lie in memory otherwise than row by row, and maps that are shared by a batch."""
        bank = make_bank(4, 2, 5, device=device)
        image, defocus = make_scene(bank, 2, 24, 40)
        expected = render(image, defocus[:1], bank, method="compiled")
        image = image.to(memory_format=torch.channels_last)
        defocus = defocus.transpose(-2, -1).contiguous().transpose(-2, -1)
        options = {"layers": "linear", "border": "valid"}
        self.assert_close(render(image, defocus[:1], bank, method="compiled"), expected, rtol=0, atol=1e-14)
        dense = render(image, defocus, bank, method="dense", **options)
        self.assert_close(render(image, defocus, bank, method="compiled", **options), dense, rtol=0, atol=1e-13)

    @pytest.mark.parametrize("compositing", COMPOSITING)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("size", [5, 31])
    def test_feature_the_same_bits_on_any_number_of_threads(self, compositing, layers, size, device, dtype):
        """But for gradients of PSFs, which are summed in as many parts as there are threads."""
        bank = make_bank(6, 3, size, dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 70, 50)
        before, results = torch.get_num_threads(), []
        try:
            for count in (1, 3):
                torch.set_num_threads(count)
                psfs, light = bank.psfs.clone().requires_grad_(), image.clone().requires_grad_()
                scene = Bank(psfs, bank.defocus, bank.veil)
                coded = render(light, defocus, scene, compositing, layers=layers, method="compiled")
                if compositing != "occlusion":  # whose gradients are not made in C
                    coded.square().sum().backward()
                results.append((coded.detach(), light.grad, psfs.grad))
        finally:
            torch.set_num_threads(before)
        for coded, *gradients in results[1:]:
            assert torch.equal(coded, results[0][0])
            for gradient, expected in zip(gradients, results[0][1:], strict=True):
                if expected is not None:
                    self.assert_close(gradient, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))

    def test_feature_light_too_dim_for_normal_numbers_stays(self, device):
        """A library built for speed alone would turn denormal numbers off, for the whole process."""
        bank = make_bank(2, 1, 5, dtype=torch.float32, device=device)
        image, defocus = make_scene(bank, 1, 16, 40)
        options = {"layers": "nearest", "method": "compiled"}
        dim = render(image * 1e-39, defocus, bank, **options)
        self.assert_close(1e39 * dim.double(), render(image, defocus, bank, **options), rtol=0, atol=1e-4)
        assert torch.tensor(1e-39) * 0.5 > 0

    def test_feature_gradients_on_nodes_are_those_of_the_interval_above(self, device):
        bank = make_bank(4, 1, 5, device=device)
        image, _ = make_scene(bank, 1, 12, 20)
        gradients = []
        for method in ("dense", "compiled"):
            defocus = bank.defocus[(torch.arange(12)[:, None] + torch.arange(20)) % 4][None, None].requires_grad_()
            render(image, defocus, bank, method=method).square().sum().backward()
            gradients.append(defocus.grad)
        assert gradients[0].abs().max() > 0
        self.assert_close(*gradients, rtol=1e-10, atol=1e-12)


@needs_compiler
class TestOcclusion(RenderTester):
    def test_feature_psfs_a_little_below_zero_change_nothing(self, device):
        """As interpolation and round-off leave them."""
        bank = make_bank(6, 1, 11, device=device)
        psfs = bank.psfs.clone()
        psfs[..., :3, :] = -1e-6 * torch.rand(6, 1, 3, 11, device=device)
        image, _ = make_scene(bank, 1, 45, 83)
        defocus = hard_depth("squares", bank, 45, 83)
        expected = render(image, defocus, Bank(psfs, bank.defocus), "occlusion", layers="nearest", method="dense")
        single = Bank(psfs.float(), bank.defocus.float())
        coded = render(image.float(), defocus.float(), single, "occlusion", layers="nearest", method="compiled")
        self.assert_close(coded.double(), expected, rtol=0, atol=2e-5)

    @pytest.mark.parametrize("layer", [-(2.0**63), -1.0, 3.0, float("nan")])
    @pytest.mark.parametrize("shared", [False, True])
    def test_feature_a_pixel_in_no_layer_is_dark_and_no_crash(self, layer, shared, device):
        """What a depth that is not a number may come to."""
        lower = torch.ones(1, 40, 60, device=device)
        lower[0, 20, 30] = layer
        fraction = torch.full((1, 40, 60), 0.5, device=device) if shared else None
        light, psfs = torch.rand(1, 1, 40, 60, device=device), torch.rand(3, 1, 7, 7, device=device)
        inside = torch.ones(1, 40, 60, device=device)
        inside[0, 20, 30] = 0
        coded = occlusion_direct(light, psfs, lower, fraction, None, None, None)
        expected = occlusion_direct(light, psfs, torch.ones_like(lower), fraction, None, None, inside)
        self.assert_close(coded, expected, rtol=0, atol=1e-6)


class TestRefusal(BaseTester):
    @needs_compiler
    @pytest.mark.parametrize(
        ("size", "where", "compositing", "below_zero", "message"),
        [
            ((8, 64), "meta", "gather", 0, "it runs on processors, and the image is on 'meta'"),
            ((7, 64), "cpu", "occlusion", 0, "its occlusion needs an output of at least 8x32 pixels, got 7x64"),
            ((40, 31), "cpu", "occlusion", 0, "its occlusion needs an output of at least 8x32 pixels, got 40x31"),
            ((40, 64), "cpu", "occlusion", 0.001, "needs PSFs without negative values, got one with -.* below zero"),
        ],
    )
    def test_exception_names_why_a_scene_is_refused(self, size, where, compositing, below_zero, message):
        image, bank = torch.rand(1, 3, *size), make_bank(size=7, dtype=torch.float32)
        options = {"compositing": compositing, "border": "replicate"}
        bank.psfs[0] -= below_zero
        bank.psfs[0, :, 0] -= 5 * below_zero
        tensors = image, torch.zeros_like(image[:, :1]), bank.defocus, bank.psfs
        scene = layered_scene(*tensors, **options)
        if where == "meta":
            scene = replace(scene, image=scene.image.to("meta"))
        with pytest.raises(ValueError, match=f"method 'compiled' does not support this scene: .*{message}"):
            choose(scene, "compiled")
        assert choose(scene).name != "compiled"

    @pytest.mark.takes_seconds
    def test_feature_without_a_compiler_it_is_refused(self, tmp_path):
        """In a process of its own, whose compiler does nothing."""
        code = (
            "import torch, warnings; warnings.simplefilter('ignore')\n"
            "from kornia_tidy.render.dispatch import explain\n"
            "from kornia_tidy.render.scene import layered_scene\n"
            "for compositing in ('gather', 'scatter', 'occlusion'):\n"
            "    scene = layered_scene(torch.rand(1, 1, 40, 40), torch.zeros(1, 1, 40, 40), torch.zeros(1),\n"
            "                          torch.rand(1, 1, 3, 3), compositing=compositing)\n"
            "    print(explain(scene).backend, explain(scene).objections['compiled'])\n"
        )
        environment = {**os.environ, "CC": "false", "XDG_CACHE_HOME": str(tmp_path)}
        run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert run.stdout.count("batched it needs a C compiler") == 3


class TestWindowSize(BaseTester):
    def test_cardinality_windows_hold_the_psf_twice_and_have_a_size_that_c_transforms(self):
        for side in range(1, 2050, 2):
            size = window_size(side)
            assert size >= 2.5 * side
            assert all(is_window_size(size, dtype) for dtype in (torch.float32, torch.float64))
            assert size <= 1.25 * (2.5 * side + 32)
