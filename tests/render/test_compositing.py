from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch

from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING, render
from tests.base import BaseTester
from tests.render.render_tester import METHODS
from tests.render.scenes import Bank, brute_render, make_bank, make_scene, modelled, squares

SUMS = ("gather", "scatter")  # the others renormalise
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)
over_sums = pytest.mark.parametrize("compositing", SUMS)


def one_layer(psf, **options) -> Bank:
    return Bank(psf[None], torch.zeros(1, dtype=psf.dtype, device=psf.device), **options)


class TestRender(BaseTester):
    @over_compositing
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("size", [(7, 8), (8, 7), (16, 5), (9, 9)], ids=str)
    @pytest.mark.parametrize("channels", [1, 3])
    def test_cardinality(self, compositing, border, size, channels, device):
        bank = make_bank(channels=channels, dtype=torch.float32, device=device)
        lost = 4 if border == "valid" else 0
        shape = render(*make_scene(bank, 2, *size), bank, compositing, border=border).shape
        assert shape == (2, channels, size[0] - lost, size[1] - lost)

    # Against models that share no code with the renderer

    @over_compositing
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_sum_over_pixels(self, compositing, layers, border, device):
        for count, channels, size, height, width in ((4, 1, 3, 5, 6), (1, 2, 5, 5, 7), (3, 1, 1, 2, 3)):
            bank = make_bank(count, channels, size, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, 2, height, width)
            options = {"compositing": compositing, "layers": layers, "border": border}
            expected = brute_render(image, defocus, bank, **options)
            for method in METHODS:
                coded = render(image, defocus, bank, method=method, **options)
                self.assert_close(coded, expected, rtol=0, atol=1e-12 if compositing == "occlusion" else 1e-14)

    @over_compositing
    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero", "circular"])
    def test_feature_equals_the_independent_model(self, compositing, border):
        bank = make_bank(6, 3, 11)
        image, defocus = make_scene(bank, 1, 33, 40)
        if compositing == "occlusion":  # which divides our round-off by EPSILON or more
            defocus = squares(bank, 33, 40)
        expected = modelled(image, defocus, bank, compositing, border)
        for method in METHODS:
            coded = render(image, defocus, bank, compositing, layers="nearest", border=border, method=method)
            self.assert_close(coded[0], expected, rtol=0, atol=1e-10 if compositing == "occlusion" else 1e-12)

    def test_feature_correlation_equals_the_independent_model(self):
        bank = make_bank(6, 3, 11)
        image, defocus = make_scene(bank, 1, 33, 40)
        expected = modelled(image, defocus, Bank(bank.psfs.flip((-2, -1)), bank.defocus), "gather", "reflect")
        coded = render(image, defocus, bank, layers="nearest", correlate=True)
        self.assert_close(coded[0], expected, rtol=0, atol=1e-12)

    # Conventions

    @over_sums
    @pytest.mark.parametrize(("correlate", "expected"), [(False, (6, 9)), (True, (4, 5))])
    def test_convention_a_peak_right_and_below_centre_moves_a_point_right_and_down(
        self, compositing, correlate, expected, device, dtype
    ):
        psf = torch.zeros(1, 5, 5, device=device, dtype=dtype)
        psf[0, 2 + 1, 2 + 2] = 1
        image = torch.zeros(1, 1, 11, 13, device=device, dtype=dtype)
        image[0, 0, 5, 7] = 1
        coded = render(image, torch.zeros_like(image), one_layer(psf), compositing, correlate=correlate)
        assert divmod(int(coded.argmax()), 13) == expected

    # Physics

    @pytest.mark.parametrize("light", [1.0, 0.7])
    @pytest.mark.parametrize("border", ["reflect", "replicate", "circular", "valid"])
    def test_property_gather_keeps_white_white(self, light, border, device, dtype):
        bank = make_bank(6, 3, 7, dtype=dtype, device=device, light=light, veil=light < 1)
        image, defocus = make_scene(bank, 2, 24, 17)
        coded = render(torch.ones_like(image), defocus, bank, border=border)
        atol = 1e-12 if dtype == torch.float64 else 1e-6
        self.assert_close(coded, torch.ones_like(coded), rtol=0, atol=atol)

    @pytest.mark.parametrize("light", [1.0, 0.7])
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    def test_property_scatter_conserves_flux_on_a_circular_plane(self, light, layers, device, dtype):
        bank = make_bank(6, 3, 7, dtype=dtype, device=device, light=light, veil=light < 1)
        image, defocus = make_scene(bank, 2, 24, 17)
        coded = render(image, defocus, bank, "scatter", layers=layers, border="circular")
        rtol = 1e-13 if dtype == torch.float64 else 1e-6
        self.assert_close(coded.mean((-2, -1)), image.mean((-2, -1)), rtol=rtol, atol=0)

    # What is skipped, shared and shaped

    @over_compositing
    def test_feature_one_defocus_map_serves_all_images(self, compositing, device, dtype):
        bank = make_bank(dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, batch=3)
        together = render(image, defocus[:1], bank, compositing)
        for b in range(3):
            alone = render(image[b : b + 1], defocus[:1], bank, compositing)
            self.assert_close(together[b : b + 1], alone, rtol=0, atol=1e-13 if dtype == torch.float64 else 1e-6)

    @over_compositing
    def test_feature_gradients_of_psfs_without_images_are_zero(self, compositing, device, dtype):
        bank = make_bank(dtype=dtype, device=device)
        (image, defocus), psfs = make_scene(bank), bank.psfs.requires_grad_()
        COMPOSITING[compositing](image[:0], defocus[:0], bank.defocus, psfs, None).sum().backward()
        assert torch.equal(psfs.grad, torch.zeros_like(psfs))

    @over_compositing
    def test_feature_any_memory_layout(self, compositing, device, dtype):
        bank = make_bank(dtype=dtype, device=device)
        image, defocus = make_scene(bank)
        expected = render(image, defocus, bank, compositing)
        strided = image.transpose(2, 3).contiguous().transpose(2, 3)
        for layout in (image.to(memory_format=torch.channels_last), strided):
            assert not layout.is_contiguous()
            other = defocus.transpose(2, 3).contiguous().transpose(2, 3)
            self.assert_close(render(layout, other, bank, compositing), expected, rtol=0, atol=1e-6)

    @over_compositing
    def test_feature_render_is_the_function_it_names(self, compositing, device, dtype):
        bank = make_bank(dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank)
        options = {"layers": "nearest", "border": "zero", "correlate": True}
        expected = COMPOSITING[compositing](image, defocus, bank.defocus, bank.psfs, bank.veil, **options)
        assert torch.equal(render(image, defocus, bank, compositing, **options), expected)

    # Errors

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"image": (3, 9, 12)}, "image must have shape (B, C, H, W), got (3, 9, 12)"),
            ({"image": (2, 1, 9, 12)}, "image and psfs must have the same channels, got 1 and 3"),
            ({"defocus": (2, 9, 12)}, "defocus must have shape (B, 1, H, W), got (2, 9, 12)"),
            ({"defocus": (2, 1, 9, 11)}, "shape (2, 1, 9, 12) or (1, 1, 9, 12), got (2, 1, 9, 11)"),
            ({"defocus": (2, 3, 9, 12)}, "shape (2, 1, 9, 12) or (1, 1, 9, 12), got (2, 3, 9, 12)"),
            ({"defocus": (3, 1, 9, 12)}, "shape (2, 1, 9, 12) or (1, 1, 9, 12), got (3, 1, 9, 12)"),
            ({"psfs": (3, 5, 5)}, "psfs must have shape (D, C, P, P), got (3, 5, 5)"),
            ({"psfs": (4, 3, 4, 4)}, "psfs must be square with an odd side, which has a centre, got 4x4"),
            ({"psfs": (4, 3, 5, 3)}, "psfs must be square with an odd side, which has a centre, got 5x3"),
            ({"nodes": (3,)}, "nodes must have shape (4,), one defocus a PSF layer, got (3,)"),
            ({"veil": (4,)}, "stray light must have shape (4, 3), one value a layer and channel, got (4,)"),
        ],
    )
    @pytest.mark.parametrize("function", COMPOSITING.values(), ids=COMPOSITING)
    def test_exception_names_the_shape_that_does_not_fit(self, function, change, message):
        shapes = {"image": (2, 3, 9, 12), "defocus": (2, 1, 9, 12), "nodes": (4,), "psfs": (4, 3, 5, 5), "veil": (4, 3)}
        with pytest.raises(ValueError, match=re.escape(message)):
            function(**{name: torch.zeros(shape) for name, shape in (shapes | change).items()})

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"compositing": "splat"}, "compositing must be one of 'gather', 'scatter', 'occlusion', got 'splat'"),
            ({"layers": "cubic"}, "layers must be one of 'nearest', 'linear', got 'cubic'"),
            ({"border": "mirror"}, "border must be one of 'reflect', .* got 'mirror'"),
        ],
    )
    def test_exception_names_the_choices(self, change, message):
        bank = make_bank()
        with pytest.raises(ValueError, match=message):
            render(*make_scene(bank), bank, **change)

    def test_exception_integers_and_unsorted_nodes(self):
        bank = make_bank()
        image, defocus = make_scene(bank)
        with pytest.raises(TypeError, match="image must be floating point"):
            render((255 * image).byte(), defocus, bank)
        with pytest.raises(ValueError, match="nodes must ascend strictly"):
            render(image, defocus, replace(bank, defocus=bank.defocus.flip(0)))

    @over_compositing
    @pytest.mark.parametrize("border", ["reflect", "circular", "valid"])
    def test_exception_an_image_too_small_for_the_border(self, compositing, border):
        bank = make_bank(2, 1, 9)
        image, defocus = make_scene(bank, 1, 3, 30)
        message = "pixels a side for PSFs of 9x9, got 3x30; borders that work here: 'replicate', 'zero'"
        with pytest.raises(ValueError, match=f"border '{border}' needs .* {message}"):
            render(image, defocus, bank, compositing, border=border)
        assert render(image, defocus, bank, compositing, border="zero").shape == image.shape
