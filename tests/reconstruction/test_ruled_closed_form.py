"""The closed form whose settings follow from PSFs and noise: its predictions against simulated pictures."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.filters import gaussian_blur2d
from torch._subclasses import FakeTensorMode

from kornia_tidy import PSFBank, SensorNoise
from kornia_tidy.data import PHOTOGRAPHS
from kornia_tidy.reconstruction import ClosedFormHead, RuledClosedForm, reconstruct_tiled, ruled_closed_form
from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.closed_form import NODES, WIENER_NOISES
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.predicted_error import predicted_errors
from kornia_tidy.reconstruction.ruled_closed_form import (
    BEFORE_BILATERAL,
    CAMERA_MAPS,
    COLORS,
    FILTERS,
    NOISES,
    STEPS,
    band_facts,
    light_detail,
)
from kornia_tidy.reconstruction.whole_picture import whole_picture
from tests.base import BaseTester
from tests.reconstruction.test_closed_form import bank, photo


def ruled(psfs=None, layers=0, dtype=torch.float64, *, encoded=True):
    restore = RuledClosedForm(layers, encoded=encoded).to(dtype)
    restore.set_psfs(bank(layers or NODES, dtype=dtype) if psfs is None else psfs)
    return restore


def points(count=NODES):
    """PSFs of a lens that does not blur."""
    psfs = torch.zeros(count, 3, 9, 9, dtype=torch.float64)
    psfs[..., 4, 4] = 1
    return PSFBank.from_measured(psfs, torch.arange(float(count), dtype=torch.float64))


def place(restore, light, noise):
    """Of the kernel that restores light."""
    return restore.settings(light, torch.full_like(light, noise)).place.flatten()


def painted(side, count, seed=0):
    """Periodic random pictures with the power spectrum of photographs, without mean, (count, 1, side, side)."""
    noise = torch.randn(count, 1, side, side, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    power = PHOTOGRAPHS.cell_power(side) * side**2
    power[:, 1 : (side + 1) // 2] /= 2
    power[0, 0] = 0
    return torch.fft.irfft2(torch.fft.rfft2(noise) * power.sqrt(), s=(side, side))


def circular(image, kernel):
    side, reach = image.shape[-1], kernel.shape[-1]
    plane = torch.zeros(*kernel.shape[:-2], side, side, dtype=image.dtype)
    plane[..., :reach, :reach] = kernel
    plane = plane.roll((-(reach // 2), -(reach // 2)), (-2, -1))
    return torch.fft.irfft2(torch.fft.rfft2(image) * torch.fft.rfft2(plane), s=(side, side))


class TestRuledClosedForm(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_the_error_without_noise_is_that_of_simulated_pictures(self):
        """Periodic pictures of the spectrum, blurred and restored by the definition; 400 of them."""
        psfs = bank(NODES).psfs
        restore = ruled()
        side = 5 + restore.kernels.shape[-1] + 1  # 28: the plane on which it is predicted, or one like it
        shares = PHOTOGRAPHS.depth_weights(torch.linspace(-1, 1, NODES, dtype=torch.float64))
        scenes = painted(side, 400)
        found = torch.zeros(FILTERS, dtype=torch.float64)
        for share, psf in zip(shares, psfs, strict=True):
            seen = circular(scenes, psf)
            for index, kernel in enumerate(restore.places):
                found[index] += share * (circular(seen, kernel) - scenes).square().mean()
        told, _ = predicted_errors(psfs, restore.places)
        assert ((told / found).log().abs() < 0.1).all()

    def test_feature_photographs_have_the_detail_that_is_foretold(self):
        psfs = bank(NODES).psfs
        _, detail = predicted_errors(psfs, torch.zeros(1, 3, 59, 59, dtype=torch.float64))  # a plane of 64 pixels
        shares = PHOTOGRAPHS.depth_weights(torch.linspace(-1, 1, NODES, dtype=torch.float64))
        scenes = painted(64, 50)
        found = sum(s * light_detail(circular(scenes, psf)).mean() for s, psf in zip(shares, psfs, strict=True))
        assert abs(math.log(float(detail / found))) < 0.1

    def test_feature_errors_between_two_kernels_are_those_of_their_blend(self):
        restore = ruled()
        blend = 0.25 * restore.places[2:3] + 0.75 * restore.places[3:4]
        error, _ = predicted_errors(restore.psfs, blend)
        found = 2 * STEPS + 3 * STEPS // 4
        self.assert_close(restore.scene_errors[found], error[0])
        self.assert_close(restore.norms[found].square(), blend.square().sum((-2, -1)).mean())

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("noise", [0.002, 0.01, 0.03])
    def test_feature_the_kernel_is_the_one_of_least_error_on_simulated_pictures(self, noise):
        """Of blends of two kernels each, by simulated scene and the noise that counts: within 5 % of the best."""
        restore = ruled(encoded=False)
        scene = 0.4 + 0.5 * painted(96, 2, seed=1).clamp(-0.7, 1).expand(-1, 3, -1, -1)
        shares = PHOTOGRAPHS.depth_weights(torch.linspace(-1, 1, NODES, dtype=torch.float64))
        seen = torch.stack(
            [torch.cat([circular(scene[:, c : c + 1], psf[c]) for c in range(3)], 1) for psf in bank(NODES).psfs]
        )
        drawn = noise * torch.randn(scene.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        apart = torch.stack([convolve_kernels(each, restore.places) - scene[:, None] for each in seen])
        left = convolve_kernels(drawn, restore.places)

        def product(first, second):
            """Of two kernels' errors."""
            scenes, drawn = (
                (apart[:, :, first] * apart[:, :, second]).mean((1, 2, 3, 4)),
                left[:, first] * left[:, second],
            )
            return float(shares @ scenes + BEFORE_BILATERAL * drawn.mean())

        pairs = [(product(k, k), product(k, k + 1), product(k + 1, k + 1)) for k in range(FILTERS - 1)]

        def error(place):
            low = min(int(place), FILTERS - 2)
            rest, (one, both, other) = place - low, pairs[low]
            return (1 - rest) ** 2 * one + 2 * rest * (1 - rest) * both + rest**2 * other

        chosen = place(restore, (seen + drawn).flatten(0, 1), noise)
        errors = [error(i / STEPS) for i in range((FILTERS - 1) * STEPS + 1)]
        assert error(float(chosen.mean())) < 1.05 * min(errors)

    def test_feature_a_cut_kernel_is_taken_less_sharp(self):
        """Two far points as a PSF: its inverse reaches far beyond the window, and the sharpest one is worse."""
        psfs = torch.zeros(NODES, 3, 9, 9, dtype=torch.float64)
        psfs[..., 4, 0], psfs[..., 4, 8] = 0.5, 0.5
        restore = ruled(PSFBank.from_measured(psfs, torch.arange(float(NODES), dtype=torch.float64)))
        scene = photo(40, 40)
        assert restore.scene_errors.argmin() > 0
        assert (place(restore, scene, 1e-4) > 1).all()
        assert (place(ruled(), scene, 1e-4) < 0.5).all()

    def test_feature_a_blank_scene_is_smoothed_more(self):
        restore, capture = ruled(encoded=False), photo(40, 40)
        assert (place(restore, 0.3 + 0.02 * capture, 0.01) > place(restore, capture, 0.01) + 0.5).all()

    @pytest.mark.parametrize("noise", [0.003, 0.01, 0.03])
    def test_feature_the_width_in_colour_is_nearly_the_best_for_a_picture(self, noise):
        """Behind a lens that does not blur: beside the best width by the truth, of a picture with texture and edges."""
        restore = ruled(points(), encoded=False)
        scene = 0.4 + 0.5 * painted(120, 1, seed=3).clamp(-0.7, 1).expand(-1, 3, -1, -1)
        scene = torch.where(scene.mean(1, keepdim=True) > 0.45, scene + 0.2, scene).clamp(0, 1)
        generator = torch.Generator().manual_seed(0)
        light = scene + noise * torch.randn(scene.shape, dtype=torch.float64, generator=generator)
        found = restore.settings(light, torch.full_like(light, noise))
        unsmoothed = restore._restored(light, light, torch.full_like(light, noise), found.place, 0 * found.color).image
        errors = {0.0: float((unsmoothed - scene).square().mean())}
        errors |= {c: float((bilateral_filter(unsmoothed, c) - scene).square().mean()) for c in COLORS}
        chosen = min(errors, key=lambda color: abs(color - float(found.color)))
        assert errors[chosen] < 1.1 * min(errors.values())
        assert errors[chosen] < 0.9 * errors[0.0]

    def test_feature_a_capture_in_bright_light_that_is_not_blurred_stays(self):
        restore, capture = ruled(points()), photo(40, 40)
        self.assert_close(restore(capture, 1e-4).image, capture, atol=1e-4, rtol=0)

    def test_feature_soft_scenes_are_restored_as_soft(self, monkeypatch):
        """A scene with a hundredth of the fine detail of photographs: not as one with three times as much."""
        generator = torch.Generator().manual_seed(0)
        scene = gaussian_blur2d(
            torch.rand(1, 3, 96, 96, generator=generator, dtype=torch.float64), (41, 41), (8.0, 8.0)
        )
        scene = 0.5 + 0.02 * (scene - scene.mean()) / scene.std()
        restore = ruled(encoded=False)
        seen = convolve_kernels(scene, restore.psfs.mean(0)[None])[:, 0]
        seen = seen + 0.003 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)

        def error():
            return float((restore(seen, 0.003).image - scene).square().mean())

        soft = error()
        monkeypatch.setattr(ruled_closed_form, "CONTENT", (0.03, 4.0))
        assert float(restore.settings_of(seen, 0.003).detail) < 0.03
        assert soft < 0.9 * error()

    @pytest.mark.filterwarnings("ignore:sigma is 2.4 times full scale")
    @pytest.mark.parametrize("electrons", [1.0, 20.0])
    def test_feature_next_to_no_light_leaves_next_to_no_noise(self, electrons):
        sensor = SensorNoise(2.4 / electrons, full_well=electrons)
        light = torch.full((1, 3, 64, 64), 0.3, dtype=torch.float64)
        seen = sensor(light, generator=torch.Generator().manual_seed(0))
        for restore in (ruled(points(), encoded=False), ruled(encoded=False)):
            image = restore(seen, sensor.std(seen)).image
            assert image.isfinite().all()
            assert (image - image.mean()).square().mean() < 0.2 * (seen - seen.mean()).square().mean()

    def test_feature_noise_of_the_sensor_counts_in_each_pixel(self):
        """As a map that is told."""
        restore, sensor = ruled(), SensorNoise(0.003, full_well=500.0)
        restore.set_noise(sensor)
        capture = photo(40, 40)
        told = sensor.std(restore._light(capture))
        self.assert_close(restore(capture, told).image, restore(capture).image)

    def test_feature_tiles_are_the_whole_picture(self):
        head = ClosedFormHead()
        head.closed_form = ruled(dtype=torch.float32)
        head.eval()
        head.closed_form.set_noise(SensorNoise(0.003, full_well=2000.0))
        capture = photo(40, 330, dtype=torch.float32)[:1]
        capture[..., :100] *= 0.5
        with torch.no_grad():
            whole, tiled = head(capture), reconstruct_tiled(head, capture, tile=(48, 160))
        self.assert_close(tiled, whole, atol=2e-3, rtol=0)
        assert (tiled - whole).abs().mean() < 2e-5

    def test_feature_the_mean_of_a_picture_counts_what_is_expected_beyond_full_scale(self):
        restore, light = ruled(encoded=False), photo(600, 24)
        light[..., 240:270, 4:20] = 1.0  # over the seam of two strips
        with whole_picture(restore, light):
            found = restore.mean_light
        self.assert_close(found, restore.completed(light).mean((-2, -1), keepdim=True), rtol=1e-6, atol=0)
        assert (found > light.mean((-2, -1), keepdim=True) + 0.002).all()

    @pytest.mark.parametrize("told", [False, True])
    @pytest.mark.takes_seconds
    def test_dynamo_settings_of_a_tile_in_a_graph_are_those_of_eager_runs(self, told, monkeypatch):
        """Eager runs tell a sensor's noise from another by its values, and a graph has none."""
        restore, light = ruled(), photo(24, 24)
        restore.set_noise(SensorNoise(0.003, full_well=500.0))
        tile = light[..., :16, :20]
        noise = torch.full_like(tile, 0.02) if told else restore._noise_of(tile)
        with whole_picture(restore, light):
            eager = restore.settings(tile, noise)
            monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
            for found, expected in zip(restore.settings(tile, noise), eager, strict=True):
                self.assert_close(found, expected)
            with FakeTensorMode(allow_non_fake_inputs=True):  # refuses to show values
                restore.settings(tile, noise)

    def test_feature_clipped_pixels_are_told(self):
        capture = photo(16, 16)
        capture[0, 1, 3, 4] = 1.0
        known = ruled()(capture, 0.01).maps[:, -CAMERA_MAPS]
        assert (known == 0).nonzero().tolist() == [[0, 3, 4]]

    def test_feature_of_more_noise_than_any_wiener_filter_is_for_the_last_one_leaves_a_share(self):
        restore, capture = ruled(), photo(16, 16)
        left = [restore(capture, noise).maps[0, 1 - CAMERA_MAPS, 0, 0] for noise in (WIENER_NOISES[-1], 0.1, 0.3)]
        norm = restore.places[len(NOISES) - 1].square().sum((-2, -1)).mean().sqrt()
        for noise, logarithm in zip((WIENER_NOISES[-1], 0.1, 0.3), left, strict=True):
            self.assert_close(10 ** (logarithm - 2), noise * norm, rtol=1e-6, atol=0)

    def test_feature_bands_of_a_mirror_without_blur_are_whole(self):
        lost, transfer = band_facts(torch.eye(1, dtype=torch.float64).expand(NODES, 3, 1, 1))
        assert (lost[:, :3] < lost[:, 1:]).all()
        self.assert_close(transfer, torch.ones_like(transfer))

    def test_exception_no_psfs(self):
        with pytest.raises(ValueError, match="the closed form does not know its camera"):
            RuledClosedForm()(photo(16, 16))

    def test_gradcheck_captures(self):
        restore = ruled()
        self.gradcheck(lambda capture: restore(capture, 0.01).image, (photo(12, 12),))
