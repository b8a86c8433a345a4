from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.augmentation import LinearCamera
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene
from tests.rounding import gamma


def linear(compositing: str = "gather", border: str = "reflect", **options: object) -> TiDyOptics:
    return camera(compositing=compositing, border=border, sensor=None, color_space="linear", **options)


class TestLinearCamera(BaseTester):
    @pytest.mark.parametrize("border", ["reflect", "valid"])
    @pytest.mark.parametrize("channels", [1, 3])
    def test_cardinality(self, border, channels):
        image, depth = scene(2, channels)
        operator = LinearCamera(linear(border=border), depth)
        irradiance = operator(image)
        assert irradiance.shape == linear(border=border)(image, depth).shape
        assert operator.adjoint(irradiance).shape == image.shape

    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero", "circular", "valid"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @pytest.mark.parametrize("kind", [torch.float32, torch.float64])
    def test_feature_dot_product(self, compositing, border, kind):
        """<A x, y> = <x, A' y>, but for the rounding of sums of as many products as a PSF has pixels, and of FFTs."""
        image, depth = scene(2)
        operator = LinearCamera(linear(compositing, border), depth)
        x = torch.randn(image.shape, dtype=kind)
        ax = operator(x)
        y = torch.randn(ax.shape, dtype=kind)
        left, right = (ax.double() * y.double()).sum(), (x.double() * operator.adjoint(y).double()).sum()
        # Every product of the two bilinear forms is rounded as often as a PSF has pixels and layers, in either order.
        size = (operator(x.abs()).double().abs() * y.abs().double()).sum()
        assert (left - right).abs() < 2 * gamma(9 * 9 * 5, kind) * size

    @pytest.mark.filterwarnings(
        "ignore:There is a performance drop:UserWarning", "ignore:.torch.jit:DeprecationWarning"
    )
    @pytest.mark.parametrize("lens", [None, "single-50mm"])
    def test_feature_transforms_of_torch_func(self, lens):
        """The derivative of A along x is A x, and that of the square of A x is twice its transpose."""
        image, depth = (part.double() for part in scene(2))
        operator = LinearCamera(linear(masks=PixelwiseMask(1), lens=lens), depth[:1])
        for function, back in ((operator, operator.adjoint), (operator.adjoint, operator)):
            expected = function(image).detach()
            self.assert_close(torch.func.jvp(function, (1 - image,), (image,))[1], expected, atol=1e-9)
            each = torch.vmap(lambda one, f=function: f(one[None])[0])(image)
            self.assert_close(each, expected, atol=1e-9)
            slope = torch.func.grad(lambda x, f=function: f(x).square().sum())(image)
            self.assert_close(slope, 2 * back(expected).detach(), atol=1e-9)

    def test_feature_each_image_has_its_place_behind_a_lens(self):
        """Of a depth for each image, and of one for all; the transpose too."""
        fidelity = Fidelity(window=9, layer_spacing=20.0)
        optics = TiDyOptics(PixelwiseMask(1), lens="single-50mm", fidelity=fidelity, sensor=None, color_space="linear")
        places, image = [(450.0, 520.0), (0.0, -20.0)], torch.rand(2, 3, 24, 30)
        depth = torch.linspace(0.4, 2.0, 2 * 24 * 30).view(2, 1, 24, 30)
        for own in (depth, depth[:1]):
            operator = LinearCamera(optics, own, field_center=torch.tensor(places))
            alone = [
                LinearCamera(optics, d, field_center=at)
                for d, at in zip(own.expand(2, -1, -1, -1), places, strict=True)
            ]
            self.assert_close(operator(image), optics(image, own, field_center=places), rtol=0, atol=1e-6)
            for move in (lambda a, x: a(x), lambda a, x: a.adjoint(x)):
                one_by_one = torch.cat([move(a, x) for a, x in zip(alone, image[:, None], strict=True)])
                self.assert_close(move(operator, image), one_by_one, rtol=0, atol=1e-5)
            seen = image.clone().requires_grad_()
            (slope,) = torch.autograd.grad(operator.adjoint(seen).square().sum() / 2, seen)
            self.assert_close(slope, operator(operator.adjoint(image)), rtol=0, atol=1e-5)
        with pytest.raises(ValueError, match="one place, or one for each of 2 images, got 3"):
            LinearCamera(optics, depth, field_center=[(0.0, 0.0)] * 3)
        with pytest.raises(ValueError, match="one place, or one for each of 1 images, got 2"):
            operator(image[:1])

    def test_feature_it_is_the_capture_in_linear_light_without_noise(self):
        image, depth = scene(2)
        for compositing in ("gather", "scatter"):
            optics = linear(compositing)
            self.assert_close(LinearCamera(optics, depth)(image), optics(image, depth))

    def test_feature_gradients_reach_the_masks(self):
        image, depth = scene(1)
        optics = linear()
        LinearCamera(optics, depth)(image).square().sum().backward()
        assert optics.masks.phase.grad.abs().sum() > 0

    def test_exception(self):
        depth = scene(1)[1]
        with pytest.raises(ValueError, match="needs compositing 'gather' or 'scatter', got 'occlusion'"):
            LinearCamera(linear("occlusion"), depth)
        with pytest.raises(TypeError, match="optics must be a camera"):
            LinearCamera(torch.nn.Identity(), depth)
        with pytest.raises(ValueError, match="depth must be positive metres"):
            LinearCamera(linear(), depth * 0)

    @pytest.mark.parametrize("border", ["reflect", "valid"])
    def test_exception_images_that_do_not_fit_the_depth(self, border):
        image, depth = scene(2)
        operator = LinearCamera(linear(border=border), depth)
        for use, name in ((operator, "light"), (operator.adjoint, "irradiance")):
            with pytest.raises(TypeError, match=f"{name} must be floating point"):
                use((image * 255).byte())
            with pytest.raises(ValueError, match=rf"{name} must have \d+ x \d+ pixels and the batch of the depth"):
                use(image[..., :-1])
            with pytest.raises(ValueError, match="and the batch of the depth"):
                use(operator(image)[:1].expand(3, -1, -1, -1) if name == "irradiance" else image[[0, 1, 0]])
