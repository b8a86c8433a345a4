from __future__ import annotations

import math

import pytest
import torch
from kornia.color import linear_rgb_to_rgb

from kornia_tidy.data import PHOTOGRAPHS, SceneStatistics, measured_statistics
from kornia_tidy.data.statistics_measurement import (
    LOWEST,
    depth_shares,
    fitted_power_law,
    fitted_shade,
    linear_light,
    radial_spectrum,
)
from tests.base import BaseTester, needs_data


def pictures(scenes, count=4, size=192, seed=0):
    """Cut pictures in sRGB out of larger Gaussian fields of a spectrum, so that they are not periodic."""
    generator = torch.Generator().manual_seed(seed)
    plane = 2 * size
    frequency = torch.hypot(torch.fft.fftfreq(plane).double()[:, None], torch.fft.rfftfreq(plane).double())
    noise = torch.randn(count, plane, plane, generator=generator, dtype=torch.float64)
    field = torch.fft.irfft2(torch.fft.rfft2(noise) * scenes.spectrum(frequency).sqrt(), s=(plane, plane))
    light = (scenes.mean + field[:, None, :size, :size]).clamp(0, 1)
    return list(linear_rgb_to_rgb(light.expand(-1, 3, -1, -1)))


class TestMeasuredStatistics(BaseTester):
    @pytest.mark.parametrize("exponent", [2.0, 3.0])
    def test_feature_finds_the_statistics_that_pictures_were_made_with(self, exponent):
        """A spread of 0.07 keeps light within [0, 1]; four pictures of 6 knees a side vary by a fifth in theirs.

        A bin of the spectrum averages at least 4 pictures x 60 cells, so that its logarithm is off by 0.07. The
        exponent, fitted over two decades and a half of octaves, is then off by less than 0.05.
        """
        truth = SceneStatistics(exponent, knee=1 / 32, mean=0.45, spread=0.07)
        found = measured_statistics(pictures(truth))
        assert found.exponent == pytest.approx(exponent, abs=0.15)
        assert found.knee == pytest.approx(1 / 32, rel=0.3)
        assert found.mean == pytest.approx(0.45, abs=0.02)
        assert found.spread == pytest.approx(0.07, rel=0.15)

    def test_feature_edges_of_a_picture_do_not_leak(self):
        """The transform of a picture that is brighter on one side has a spectrum of f^-2 without a window."""
        texture = [linear_light(each) for each in pictures(SceneStatistics(4.0, 1 / 16, 0.45, 0.03))]
        ramp = torch.linspace(-0.2, 0.2, 192, dtype=torch.float64)
        plain, sloped = (radial_spectrum(each).density for each in (texture, [each + ramp for each in texture]))
        self.assert_close(sloped[-12:], plain[-12:], rtol=0.01, atol=0)

    def test_feature_grey_pictures_count_as_their_channel(self):
        colour = pictures(PHOTOGRAPHS, count=1)[0]
        grey = measured_statistics([colour[:1]])
        assert grey == measured_statistics([colour])

    def test_feature_is_the_mean_over_pictures_of_any_size(self):
        one = pictures(PHOTOGRAPHS, count=1)[0]
        other = pictures(PHOTOGRAPHS, count=1, size=64, seed=1)[0]
        both, first, second = (measured_statistics(each) for each in ([one, other], [one], [other]))
        assert both.mean == pytest.approx((first.mean + second.mean) / 2)
        assert both.spread**2 == pytest.approx((first.spread**2 + second.spread**2) / 2)

    def test_exception(self):
        image = torch.rand(3, 32, 32)
        for images, depths, said in (
            ([], None, "images must be at least one picture, got none"),
            ([image[:2]], None, r"images must be \(1 or 3, H, W\) of at least 32 pixels a side, got \(2, 32, 32\)"),
            ([image[:, 1:]], None, r"at least 32 pixels a side, got \(3, 31, 32\)"),
            ([image * 0], None, "images must have contrast, got 1 without any"),
            ([image], [], "depths must be one map for each of the 1 images, got 0"),
            ([image], [torch.ones(1, 8, 8)], r"depth must have the size of its image, \(32, 32\), got \(8, 8\)"),
            ([image], [torch.ones(1, 32, 32)], "a scene must have a range of depths, got one of 1 dioptres throughout"),
            ([image], [torch.zeros(1, 32, 32)], "a scene must have a range of depths"),
        ):
            with pytest.raises(ValueError, match=said):
                measured_statistics(images, depths)
        with pytest.raises(TypeError, match="image must be floating point"):
            measured_statistics([torch.zeros(3, 32, 32, dtype=torch.uint8)])


class TestFit(BaseTester):
    def test_feature_a_power_law_is_its_own_fit(self):
        """Bins are log-spaced, so that the density at their middles is the model's; what is left is bisection."""
        truth = SceneStatistics(2.6, knee=0.004, mean=0.3, spread=0.2)
        frequency = torch.logspace(-2, math.log10(0.5), 30, dtype=torch.float64)
        spectrum = radial_spectrum([torch.rand(1, 64, 64)])._replace(
            frequency=frequency, density=truth.spectrum(frequency)
        )
        exponent, knee = fitted_power_law(spectrum, truth.spread**2)
        assert exponent == pytest.approx(2.6, rel=1e-9)
        assert knee == pytest.approx(0.004, rel=1e-9)

    def test_feature_white_noise_has_its_variance_as_density(self):
        noise = torch.randn(8, 128, 128, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        spectrum = radial_spectrum([noise])
        assert spectrum.frequency[0] > LOWEST / 128
        self.assert_close(spectrum.density[-8:], torch.ones(8, dtype=torch.float64), rtol=0, atol=0.1)


class TestShade(BaseTester):
    def test_feature_a_constant_picture_has_no_dark_pixels(self):
        assert fitted_shade([torch.full((1, 64, 64), 0.3, dtype=torch.float64)])[0] == pytest.approx(1)

    def test_feature_light_around_is_that_of_the_model_where_the_picture_is_made_so(self):
        """Half of the columns dark, in stripes of 32 pixels: 4 pixels from a dark pixel an eighth is bright."""
        light = torch.tensor([0.02, 0.5], dtype=torch.float64).repeat_interleave(32).repeat(8).expand(1, 512, -1)
        slopes = [
            (float(linear_rgb_to_rgb(torch.full((1, 3, 1, 1), x + 0.02)).mean())
             - float(linear_rgb_to_rgb(torch.full((1, 3, 1, 1), x - 0.02)).mean())) / 0.04
            for x in (0.02, 0.5)
        ]  # fmt: skip
        dark, bright = (slope**2 / sum(slope**2 for slope in slopes) for slope in slopes)
        shade, size = fitted_shade([light])
        assert shade == pytest.approx((dark * 0.02 + bright * 0.5) / 0.26, rel=1e-6)
        assert 4 < size < 128

    def test_feature_noise_has_the_mean_light_at_any_distance(self):
        noise = torch.rand(1, 512, 512, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        shade, size = fitted_shade([noise])
        assert shade < 0.6
        assert size < 2


class TestDepthShares(BaseTester):
    def test_feature_literals(self):
        depth = torch.tensor([[[math.inf, 4.0, 2.0, 1.25, 1.0, 0.0, math.nan]]])
        assert depth_shares([depth], parts=4) == pytest.approx((0.2, 0.2, 0.2, 0.4))

    def test_feature_a_scene_counts_once_and_over_its_own_range(self):
        near, far = torch.tensor([[[0.1, 0.1, 0.2]]]), torch.tensor([[[10.0, 20.0, 20.0, 20.0]]])
        assert depth_shares([near, far], parts=2) == pytest.approx(((1 / 3 + 3 / 4) / 2, (2 / 3 + 1 / 4) / 2))

    def test_feature_a_stray_pixel_does_not_stretch_the_range(self):
        depth = torch.cat([torch.linspace(1, 2, 999).reciprocal(), torch.tensor([1e-3])]).view(1, 1, -1)
        assert min(depth_shares([depth], parts=2)) > 0.49


@needs_data
class TestPhotographs(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_published_numbers_are_those_of_half_a(self):
        """To the digits that are published."""
        from tests.benchmarks.scene_statistics import half_a

        found = measured_statistics(*half_a())
        assert found.exponent == pytest.approx(PHOTOGRAPHS.exponent, abs=0.006)
        assert 1 / found.knee == pytest.approx(1 / PHOTOGRAPHS.knee, abs=0.6)
        assert found.mean == pytest.approx(PHOTOGRAPHS.mean, abs=6e-4)
        assert found.spread == pytest.approx(PHOTOGRAPHS.spread, abs=6e-4)
        assert found.shade == pytest.approx(PHOTOGRAPHS.shade, abs=6e-4)
        assert found.shade_size == pytest.approx(PHOTOGRAPHS.shade_size, abs=0.06)
        assert found.depths == pytest.approx(PHOTOGRAPHS.depths, abs=6e-4)
