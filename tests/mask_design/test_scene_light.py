from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.mask_design.scene_light import SceneLight, lost_variance, noise_variance
from kornia_tidy.psf import PSFBank
from kornia_tidy.sensor.noise import SensorNoise
from tests.base import BaseTester


def bank_of(psfs):
    """Return a bank of one channel in float64."""
    psfs = psfs.double()[:, None]
    return PSFBank(psfs, torch.arange(len(psfs)).double(), psfs.sum((2, 3)))


def box(side, window=9):
    psf = torch.zeros(window, window)
    edge = (window - side) // 2
    psf[edge : window - edge, edge : window - edge] = 1 / side**2
    return psf


class TestSceneLight(BaseTester):
    @pytest.mark.parametrize("size", [(32, 32), (17, 40), (8, 9)])
    def test_cardinality_half_spectrum_whose_whole_sums_to_one(self, size):
        shares = SceneLight().variances(size)
        assert shares.shape == (size[0], size[1] // 2 + 1)
        inner = shares[:, 1 : (size[1] + 1) // 2].sum()  # its conjugate is left out
        assert float(shares.sum() + inner) == pytest.approx(1, rel=1e-12)

    def test_feature_each_share_is_the_average_around_its_frequency(self):
        """Against a midpoint sum of 200 x 200 points in each bin of a small plane, for the frequencies up to 3/16."""
        light, size = SceneLight(slope=2.5, knee=1 / 64), 16
        step = (np.arange(200) + 0.5) / 200 - 0.5
        power = np.zeros((4, 4))
        for row in range(4):
            for column in range(4):
                y, x = (row + step[:, None]) / size, (column + step) / size
                power[row, column] = ((y**2 + x**2 + light.knee**2) ** -1.25).mean()
        shares = light.variances((size, size))[:4, :4].numpy()
        np.testing.assert_allclose(shares / shares[0, 0], power / power[0, 0], rtol=0.01)

    @pytest.mark.parametrize("name", ["slope", "knee", "mean", "spread"])
    def test_exception_names_what_is_not_positive(self, name):
        with pytest.raises(ValueError, match=f"{name} must be positive and finite, got -1"):
            SceneLight(**{name: -1})

    def test_feature_noise_at_the_mean_light(self):
        sensor = SensorNoise(0.003, full_well=1000.0)
        assert noise_variance(sensor, SceneLight(mean=0.2)) == pytest.approx(0.003**2 + 0.2 / 1000, rel=1e-6)


class TestLostVariance(BaseTester):
    def test_feature_is_the_error_of_the_filter_written_out(self):
        """Against the error of the Wiener filter at every frequency of the whole plane, in NumPy."""
        light, sensor = SceneLight(knee=1 / 32), SensorNoise(0.02)
        psfs = torch.stack([box(1), box(3), 0.9 * box(5)])
        size = 18
        half = light.variances((size, size)).numpy()
        scene = np.concatenate([half, np.roll(half[::-1], 1, 0)[:, size // 2 - 1 : 0 : -1]], 1) * light.spread**2
        transfer = np.fft.fft2(psfs.double().numpy(), (size, size))
        transfer[2, 0, 0] += 0.1
        noise = 0.02**2 / size**2
        mean, power = transfer.mean(0), (abs(transfer) ** 2).mean(0)
        wiener = mean.conj() * scene / (power * scene + noise)
        error = (abs(1 - wiener * transfer) ** 2).mean(0) * scene + abs(wiener) ** 2 * noise
        expected = error.sum() / light.spread**2
        assert float(lost_variance(bank_of(psfs), light, sensor)) == pytest.approx(expected, rel=1e-9)

    def test_feature_noise_blur_and_change_with_depth_cost(self):
        sharp, wide, changing = (bank_of(torch.stack(psfs)) for psfs in ([box(1)] * 2, [box(5)] * 2, [box(1), box(5)]))
        quiet, loud = SensorNoise(0.001), SensorNoise(0.1)

        def lost(bank, sensor):
            return float(lost_variance(bank, SceneLight(), sensor))

        assert lost(sharp, quiet) < lost(sharp, loud)
        assert lost(sharp, loud) < lost(wide, loud)
        assert lost(sharp, quiet) < lost(changing, quiet)

    def test_feature_light_beyond_the_window_is_no_loss_of_brightness(self):
        """Half of the light as a background is half of the contrast: the same as four times the noise variance."""
        light = SceneLight()
        halved = lost_variance(bank_of(0.5 * box(1)[None]), light, SensorNoise(0.01))
        noisier = lost_variance(bank_of(box(1)[None]), light, SensorNoise(0.02))
        # They differ at frequency zero alone, where the half with the background has less noise.
        shares = light.variances((18, 18))[0, 0]
        assert abs(float(halved - noisier)) < float(shares) * 0.02**2 / light.spread**2

    def test_gradcheck(self):
        psfs = torch.rand(2, 1, 5, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) / 25

        def lost(values):
            bank = PSFBank(values, torch.arange(2.0).double(), values.sum((2, 3)))
            return lost_variance(bank, SceneLight(), SensorNoise(0.01))

        self.gradcheck(lost, (psfs,))
