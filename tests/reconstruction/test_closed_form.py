"""Restoration in closed form: its parts written out, and its noise."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from kornia_tidy import PSFBank, SensorNoise
from kornia_tidy.reconstruction import ClosedForm, closed_form_channels
from kornia_tidy.reconstruction.closed_form import FINE_WEIGHT, LAYER_WEIGHT, NODES, NOISE, WEIGHTS, WIENER_NOISES
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from tests.base import BaseTester


def bank(depths=4, side=5, dtype=torch.float64):
    """PSFs that are brightest at their centre and differ between colours and depths."""
    x = torch.arange(side, dtype=dtype) - side // 2
    widths = torch.linspace(0.5, 1.5, 3 * depths, dtype=dtype).view(depths, 3, 1, 1)
    psfs = (-(x[:, None].square() + x.square() + 0.3 * x) / (2 * widths.square())).exp()
    return PSFBank.from_measured(psfs, torch.arange(float(depths), dtype=dtype))


def closed_form(dtype=torch.float64, **options):
    restore = ClosedForm(**options).to(dtype)
    nodes = NODES if options.get("inverse") == "wiener" else 4
    restore.set_psfs(bank(options.get("layers", nodes) or nodes, dtype=dtype))
    return restore


def photo(*size, dtype=torch.float64):
    """Away from black and white, where clipping would hide differences."""
    return 0.3 + 0.3 * torch.rand(2, 3, *size, dtype=dtype, generator=torch.Generator().manual_seed(0))


def best_weight(noise):
    return 3e-3 * (noise / 0.002) ** 1.3


def bilateral(image, window=7, color=0.2, space=2.0):
    """The definition, pixel by pixel, over the interior of one image (3, H, W)."""
    radius = window // 2
    _, height, width = image.shape
    result = torch.zeros(3, height - 2 * radius, width - 2 * radius, dtype=image.dtype)
    for y in range(radius, height - radius):
        for x in range(radius, width - radius):
            total = weighted = 0.0
            for v in range(-radius, radius + 1):
                for u in range(-radius, radius + 1):
                    other = image[:, y + v, x + u]
                    apart = float((other - image[:, y, x]).abs().sum())
                    weight = math.exp(-(apart**2) / (2 * color**2) - (u * u + v * v) / (2 * space**2))
                    total, weighted = total + weight, weighted + weight * other
            result[:, y - radius, x - radius] = weighted / total
    return result


class TestClosedForm(BaseTester):
    @pytest.mark.parametrize("encoded", [True, False])
    def test_feature_maps_are_capture_deconvolutions_image_and_noise(self, encoded):
        restore, capture = closed_form(encoded=encoded, bilateral=False), photo(20, 24)
        light = rgb_to_linear_rgb(capture) if encoded else capture
        kernels = tikhonov_kernels(bank().psfs.mean(0), WEIGHTS)
        for index, weight in enumerate(WEIGHTS):
            noise = NOISE * (weight / 3e-3) ** (1 / 1.3)
            deconvolved = convolve_kernels(light, kernels[index : index + 1])[:, 0].clamp(0, 1)
            expected = linear_rgb_to_rgb(deconvolved) if encoded else deconvolved
            image, maps, _ = restore(capture, noise)
            self.assert_close(image, expected, atol=1e-9, rtol=0)
            self.assert_close(maps[:, :3], capture)
            self.assert_close(maps[:, 3 + 3 * index :][:, :3], expected)
            self.assert_close(maps[:, 15:18], image)
            self.assert_close(maps[:, 18:], torch.full_like(maps[:, 18:], math.log10(noise / 0.01)))

    def test_feature_between_two_weights_the_kernel_is_nearly_that_of_the_weight(self):
        """In ln g the transfer T = (1 - s) / h + s, s = g / (h^2 + g), has a second derivative below T. Interpolation
        over half a decade therefore differs by less than (ln 10 / 2)^2 / 8 = 0.166 of the estimate."""
        psf = bank().psfs.mean(0)
        for noise in (0.003, 0.006, 0.012, 0.02):
            capture, weight = photo(24, 24), best_weight(noise)
            image = closed_form(encoded=False, bilateral=False)(capture, noise).image
            exact, other = convolve_kernels(capture, tikhonov_kernels(psf, (weight, 4 * weight))).unbind(1)
            difference = (image - exact.clamp(0, 1)).square().mean().sqrt()
            assert difference < 0.166 * (exact - capture.mean()).square().mean().sqrt()
            assert difference < 0.5 * (image - other.clamp(0, 1)).square().mean().sqrt()

    @pytest.mark.parametrize("layers", [0, 3])
    @pytest.mark.parametrize("bilateral", [False, True])
    def test_feature_wiener_estimates_are_those_of_its_kernels(self, bilateral, layers):
        """At noises for which the filter takes one of its four: five times the variance, or half of it and more."""
        restore = closed_form(inverse="wiener", bilateral=bilateral, layers=layers, encoded=False)
        kernels = wiener_kernels(bank(layers or NODES).psfs, WIENER_NOISES)
        capture = photo(20, 24)
        for index, taken in enumerate(WIENER_NOISES):
            expected = convolve_kernels(capture, kernels[index : index + 1])[:, 0].clamp(0, 1)
            noise = taken / math.sqrt(0.5 if bilateral else 5.0)
            if bilateral and noise > 0.002:  # 0.5 noise^2 (noise / 0.002)^0.3 is what it takes
                noise = (taken**2 / 0.5 * 0.002**0.3) ** (1 / 2.3)
            image, maps, _ = restore(capture, noise)
            self.assert_close(maps[:, 3 + 3 * index :][:, :3], expected)
            if not bilateral:
                self.assert_close(image, expected)
            else:
                color = 0.2 * max(1.0, noise / 0.002) ** 0.5
                smooth = restore._smooth(expected, torch.full((1, 1, 1, 1), color))
                self.assert_close(image, smooth, atol=1e-6, rtol=0)

    @pytest.mark.parametrize("noise", [0.002, 0.008])
    def test_feature_the_bilateral_is_that_of_the_definition(self, noise):
        capture, color = photo(14, 13), 0.2 * math.sqrt(noise / 0.002)
        as_much = NOISE * (noise / NOISE) ** (0.87 / 1.3)  # noise at which the weight without a filter is the same
        deconvolved = closed_form(bilateral=False)(capture, as_much).image
        found = closed_form()(capture, noise).image
        self.assert_close(found[0, :, 3:-3, 3:-3], bilateral(deconvolved[0], color=color), atol=1e-6, rtol=0)

    @pytest.mark.parametrize("encoded", [True, False])
    def test_feature_layers_are_the_brightness_deconvolved_for_each_depth(self, encoded):
        capture = photo(20, 24)
        maps = closed_form(layers=3, encoded=encoded)(capture).maps
        light = rgb_to_linear_rgb(capture) if encoded else capture
        for layer, psf in enumerate(bank(3).psfs.mean(1, keepdim=True)):
            brightness = light.mean(1, keepdim=True)
            deconvolved = convolve_kernels(brightness, tikhonov_kernels(psf, (LAYER_WEIGHT,)))[:, 0].clamp(0, 1)
            expected = linear_rgb_to_rgb(deconvolved.expand(-1, 3, -1, -1))[:, :1] if encoded else deconvolved
            self.assert_close(maps[:, 19 + layer][:, None], expected)

    def test_feature_fine_layers_follow_the_others(self):
        capture = photo(20, 24)
        maps = closed_form(layers=3, fine=True, encoded=False)(capture).maps
        self.assert_close(maps[:, :-3], closed_form(layers=3, encoded=False)(capture).maps)
        kernels = [tikhonov_kernels(psf, (FINE_WEIGHT,)) for psf in bank(3).psfs.mean(1, keepdim=True)]
        brightness = capture.mean(1, keepdim=True)
        expected = torch.cat([convolve_kernels(brightness, each)[:, 0] for each in kernels], 1)
        self.assert_close(maps[:, -3:], expected.clamp(0, 1))
        assert maps.shape[1] == closed_form_channels(3, fine=True)

    def test_feature_samples_and_pixels_have_their_own_noise(self):
        restore, capture = closed_form(bilateral=False), photo(12, 20)
        both = restore(capture, torch.tensor([0.002, 0.03]).view(2, 1, 1, 1)).image
        for sample, noise in enumerate((0.002, 0.03)):
            self.assert_close(both[sample], restore(capture, noise).image[sample])
        halves = torch.full((1, 1, 1, 20), 0.002)
        halves[..., 10:] = 0.03
        image = restore(capture, halves).image
        self.assert_close(image[..., :10], restore(capture, 0.002).image[..., :10])
        self.assert_close(image[..., 10:], restore(capture, 0.03).image[..., 10:])
        assert not torch.allclose(both[0], restore(capture, 0.03).image[0])

    @pytest.mark.parametrize(
        "sensor", [SensorNoise(0.01), SensorNoise.physical(full_well=2000, read_noise_electrons=3, dark_electrons=20)]
    )
    def test_feature_without_a_noise_it_is_that_of_the_sensor(self, sensor):
        restore, capture = closed_form(), photo(8, 8)
        restore.set_noise(sensor)
        expected = sensor.std(rgb_to_linear_rgb(capture))
        self.assert_close(restore.noise_map(capture), expected, rtol=1e-6)
        self.assert_close(restore(capture).image, restore(capture, expected).image)

    def test_feature_flipped_psfs_for_correlations(self):
        straight, flipped = closed_form(), ClosedForm().double()
        turned = bank()
        flipped.set_psfs(PSFBank(turned.psfs.flip((-2, -1)), turned.defocus, turned.energy), correlate=True)
        self.assert_close(flipped.kernels, straight.kernels)

    def test_feature_a_state_holds_psfs_and_noise(self):
        restore, capture = closed_form(layers=3), photo(9, 9)
        restore.set_noise(SensorNoise(0.03))
        loaded = ClosedForm(3).double()
        loaded.load_state_dict(restore.state_dict())
        assert torch.equal(loaded(capture).maps, restore(capture).maps)
        assert torch.equal(copy.deepcopy(loaded)(capture).maps, restore(capture).maps)
        known = closed_form(layers=3)  # of a state of the same size
        known.set_psfs(PSFBank(bank(3).psfs.flip(-1), torch.arange(3.0), torch.ones(3, 3)))
        known.load_state_dict(restore.state_dict())
        assert torch.equal(known(capture).maps, restore(capture).maps)

    def test_feature_stray_light_is_taken_away(self):
        """The capture of a scene with a fifth of its light spread evenly, against that of its PSFs alone."""
        scene, lens = photo(20, 24), bank()
        sharp = PSFBank(0.8 * lens.psfs, lens.defocus, 0.8 * lens.energy, 1 - 0.8 * lens.energy)
        plain, stray = ClosedForm(encoded=False).double(), ClosedForm(encoded=False).double()
        plain.set_psfs(PSFBank(sharp.psfs, lens.defocus, sharp.energy))
        stray.set_psfs(sharp)
        capture = convolve_kernels(scene, sharp.psfs.mean(0, keepdim=True))[:, 0]
        mean = capture.mean((-2, -1), keepdim=True) / 0.8  # of the scene that the borders continue
        found = stray(capture + 0.2 * mean, 0.01)
        self.assert_close(found.image, plain(capture, 0.01).image)
        assert (plain(capture + 0.2 * mean, 0.01).image - found.image).abs().max() > 0.1
        stray.mean_light = mean
        self.assert_close(stray((capture + 0.2 * mean)[..., :12], 0.01).image[..., :1], found.image[..., :1], atol=1e-2)
        loaded = ClosedForm(encoded=False).double()
        loaded.load_state_dict(stray.state_dict())
        self.assert_close(loaded(capture + 0.2 * mean, 0.01).image, found.image)

    def test_feature_half_precision_is_computed_in_float32(self):
        restore, capture = closed_form(torch.float32), photo(16, 16, dtype=torch.float32)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(restore(capture).image, closed_form(torch.float32)(capture).image)
        found = restore(capture.bfloat16()).image
        assert found.dtype == torch.bfloat16
        exact = restore(capture.bfloat16().float()).image
        assert (found.float() - exact).abs().max() <= 2**-9  # half a unit in the last place below 1

    @pytest.mark.takes_seconds
    def test_dynamo(self, device):
        """Traced, kernels are applied by strided convolutions."""
        restore, capture = closed_form().to(device), photo(13, 16).to(device)
        traced = torch.compile(lambda image: restore(image, 0.01).image, backend="eager", fullgraph=True)
        self.assert_close(traced(capture), restore(capture, 0.01).image)
        restore, capture = closed_form(torch.float32).to(device), capture.float()
        with torch.autocast(device.type, dtype=torch.bfloat16):  # convolutions keep their precision
            self.assert_close(traced(capture), restore(capture, 0.01).image)

    def test_exception(self):
        restore = ClosedForm()
        with pytest.raises(ValueError, match=r"does not know its camera: call set_psfs\(optics.psf_bank\(\)\) first"):
            restore(photo(8, 8, dtype=torch.float32))
        with pytest.raises(ValueError, match=r"needs PSFs of shape \(5, 3, P, P\), got \(4, 3, 5, 5\)"):
            ClosedForm(layers=5).set_psfs(bank())
        with pytest.raises(ValueError, match=r"needs PSFs of shape \(D, 3, P, P\), got \(4, 1, 5, 5\)"):
            restore.set_psfs(PSFBank.from_measured(torch.ones(4, 1, 5, 5), torch.arange(4.0)))
        with pytest.raises(ValueError, match=r"noise must be .* broadcast to \(2, 3, 8, 8\), got \(2, 2, 1, 1\)"):
            closed_form()(photo(8, 8), torch.ones(2, 2, 1, 1))
        with pytest.raises(ValueError, match=r"noise must be .* got \(8,\)"):
            closed_form()(photo(8, 8), torch.ones(8))
        with pytest.raises(ValueError, match=r"noise must be zero or positive and finite, .*, got -1"):
            closed_form()(photo(8, 8), -1)
        for shape in ((1, 1, 8, 8), (1, 3, 0, 8)):
            with pytest.raises(ValueError, match=r"capture must have shape \(B, 3, H, W\) with one pixel or more, got"):
                closed_form()(torch.ones(shape))
        with pytest.raises(ValueError, match="layers must be a whole number of at least 0, got -1"):
            ClosedForm(-1)
        with pytest.raises(ValueError, match="inverse must be one of 'tikhonov', 'wiener', got 'inverse'"):
            ClosedForm(inverse="inverse")
        with pytest.raises(ValueError, match=r"needs PSFs of shape \(11, 3, P, P\), got \(4, 3, 5, 5\)"):
            ClosedForm(inverse="wiener").set_psfs(bank())
        for layers, likelihood in [(0, False), (2, True)]:
            with pytest.raises(ValueError, match=f"without likelihood, got layers={layers}, likelihood={likelihood}"):
                ClosedForm(layers, likelihood=likelihood, fine=True)
