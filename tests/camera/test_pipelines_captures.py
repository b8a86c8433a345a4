from __future__ import annotations

import math
import warnings

import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from kornia_tidy import FresnelLens, PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from tests.base import BaseTester
from tests.camera.pipeline_samples import FAST, camera, scene


def convolved(image: Tensor, psfs: Tensor) -> Tensor:
    """Convolution with one PSF a channel by direct sums, reflecting at the border."""
    radius = psfs.shape[-1] // 2
    padded = torch.nn.functional.pad(image, (radius,) * 4, mode="reflect")
    return torch.nn.functional.conv2d(padded, psfs.flip((-2, -1))[:, None], groups=psfs.shape[0])


class TestDepth(BaseTester):
    def test_feature_nearer_than_the_range_is_the_near_end_counted_and_said_once(self):
        optics, (image, depth) = camera(sensor=None, color_space="linear"), scene(1)
        depth = torch.full_like(depth, 0.2975)  # half the focus distance: the near end itself
        depth[..., :7] = 0.2
        with pytest.warns(UserWarning, match=r"280 of 1920 pixels have a defocus between .* and \+39.5\d rad, beyond"):
            coded = optics(image, depth)
        assert optics.clamped_pixels == 280
        self.assert_close(coded, convolved(image, optics.psf_bank().psfs[-1]))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            optics(image, depth)
        assert optics.clamped_pixels == 280
        optics(image, depth.clamp(min=0.3))
        assert optics.clamped_pixels == 0

    def test_feature_an_unchecked_camera_counts_in_silence(self):
        optics, (image, depth) = camera(check_inputs=False), scene(1)
        optics(image, torch.full_like(depth, 0.1))
        assert optics.clamped_pixels == 1920


class TestRandomness(BaseTester):
    def test_feature_a_generator_repeats_a_capture_and_leaves_the_global_one_alone(self):
        optics, (image, depth) = camera(), scene()
        before = torch.get_rng_state()
        one, two = (optics(image, depth, generator=torch.Generator().manual_seed(8)) for _ in range(2))
        assert torch.equal(one, two)
        assert torch.equal(torch.get_rng_state(), before)

    @pytest.mark.parametrize("sensor", [SensorNoise(0.02), SensorNoise.physical(8000, 3)])
    def test_feature_params_replay_what_the_global_generator_would_have_drawn(self, sensor):
        optics, (image, depth) = camera(sensor=sensor), scene()
        torch.manual_seed(2)
        direct = optics(image, depth)
        torch.manual_seed(2)
        params = optics.draw(image)
        assert torch.equal(optics(image, depth, params=params), direct)
        assert torch.equal(optics({"image": image, "depth": depth}, params=params)["image"], direct)


class TestGradients(BaseTester):
    """Through optics, scene and sensor, in float64: noise replayed, no converter, no clipping."""

    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @pytest.mark.parametrize("name", ["masks.phase", "camera.focus_distance", "image", "depth"])
    def test_gradcheck(self, name, compositing):
        lens = ThinLensCamera(focus_distance=torch.tensor(0.6), depth_range=(0.25, math.inf))
        optics = TiDyOptics(
            PixelwiseMask(2),
            lens,
            sensor=SensorNoise(0.01, clip=False),
            fidelity=FAST.replace(window=5, layer_spacing=60.0),  # two nodes: no knot inside the range
            compositing=compositing,
        ).double()
        image, depth = (x.double() for x in scene(1, height=12, width=14))
        image = 0.2 + 0.6 * image
        depth = 0.3 + 2 * torch.rand_like(depth)
        params = optics.draw(image)
        inputs = {"image": image, "depth": depth, **{n: p.detach() for n, p in optics.named_parameters()}}

        def capture(value: Tensor) -> Tensor:
            values = {**inputs, name: value}
            scene_of = values.pop("image"), values.pop("depth")
            return functional_call(optics, values, scene_of, {"params": params})

        self.gradcheck(capture, (inputs[name],))

    def test_feature_fixed_masks_have_no_gradient_and_the_image_still_has(self):
        optics, (image, depth) = camera(masks=FresnelLens()), scene()
        image.requires_grad_()
        optics(image, depth).sum().backward()
        assert not list(optics.parameters())
        assert image.grad.abs().sum() > 0
