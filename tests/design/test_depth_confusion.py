from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy.data import SceneStatistics
from kornia_tidy.design import depth_confusion
from kornia_tidy.design.depth_confusion import CONTRASTS, MISFIT, OTHER_DEPTHS, SAMPLES
from kornia_tidy.psf import PSFBank
from tests.base import BaseTester

SCENES = SceneStatistics(2.4, 0.1, 0.4, spread=0.3, depths=(0.6, 0.4))


def bank_of(psfs):
    """Return a bank of (D, P, P) PSFs of one channel."""
    count = len(psfs)
    defocus = torch.linspace(-1, 1, count, dtype=psfs.dtype, device=psfs.device)
    return PSFBank(psfs[:, None], defocus, psfs.new_ones(count, 1))


def discs(radii, window=17):
    x = torch.arange(window, dtype=torch.float64) - window // 2
    radius = torch.hypot(x[:, None], x)
    psfs = torch.stack([torch.sigmoid(4 * (r - radius)) for r in radii])
    return psfs / psfs.sum((1, 2), keepdim=True)


class TestDepthConfusion(BaseTester):
    def test_feature_is_the_sum_over_all_pairs_written_out(self):
        """By NumPy over the whole plane of frequencies, in loops over true and estimated depths and contrasts."""
        psfs, noise = torch.rand(3, 7, 7, dtype=torch.float64) / 40, 0.02
        f = np.fft.fftfreq(14)
        spectrum = SCENES.spectrum(torch.from_numpy(np.hypot(f[:, None], f))).numpy().ravel()[1:]
        transfer = np.fft.fft2(psfs.numpy(), s=(14, 14)).reshape(3, -1)[:, 1:]
        prior = SCENES.depth_weights(torch.linspace(-1, 1, 3, dtype=torch.float64)).numpy()
        power = [
            [a * spectrum * (np.abs(h) ** 2 + OTHER_DEPTHS) + MISFIT * noise**2 for a in CONTRASTS] for h in transfer
        ]
        joint = np.zeros((3, 3))
        for true in range(3):
            for own in power[true]:
                scores = np.zeros(3)
                for guess in range(3):
                    for other in power[guess]:
                        divergence = 0.5 * (own / other - 1 - np.log(own / other)).mean()
                        scores[guess] += prior[guess] * math.exp(-SAMPLES * divergence)
                joint[true] += prior[true] * scores / scores.sum() / len(CONTRASTS)
        squared = sum(joint[i, j] * (i - j) ** 2 / 4 / 2 for i in range(3) for j in range(3))
        error = 0.0
        for guess in range(3):
            shares = joint[:, guess] / joint[:, guess].sum()
            gain = (shares @ transfer.conj()) / (shares @ np.abs(transfer) ** 2 + noise**2 / spectrum)
            for true in range(3):
                left = spectrum * np.abs(1 - gain * transfer[true]) ** 2 + noise**2 * np.abs(gain) ** 2
                error += joint[true, guess] * left.mean() / spectrum.mean()
        found = depth_confusion(bank_of(psfs), noise, SCENES)
        assert float(found.depth) == pytest.approx(squared**0.5, rel=1e-9)
        assert float(found.image) == pytest.approx(error, rel=1e-9)

    def test_feature_of_equal_psfs_nothing_is_known(self):
        """Then the error is the spread of depth over the scenes."""
        alike = bank_of(discs([3.0]).expand(5, -1, -1))
        shares, place = SCENES.depth_weights(alike.defocus), torch.linspace(0, 1, 5, dtype=torch.float64)
        spread = ((place - (shares * place).sum()).square() * shares).sum().sqrt()
        self.assert_close(depth_confusion(alike, 1e-3, SCENES).depth, spread)

    @pytest.mark.parametrize("noise", [0, -1, math.inf, math.nan])
    def test_exception_noise(self, noise):
        with pytest.raises(ValueError, match="noise must be positive and finite, got"):
            depth_confusion(bank_of(discs([1.0, 2.0])), noise)

    def test_gradcheck(self):
        psfs = discs([1.0, 1.5, 2.0], window=5)
        self.gradcheck(lambda p: depth_confusion(bank_of(p), 1e-2, SCENES), (psfs,))
