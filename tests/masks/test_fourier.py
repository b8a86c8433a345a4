from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.masks import FourierMask
from tests.base import BaseTester
from tests.masks.strong import strong

TWO_MASKS = {"Fourier": lambda **o: FourierMask(2, max_frequency=3, **o)}
ONE_MASK = {
    "Fourier": lambda g: FourierMask(1, generator=g),
    "strong Fourier": lambda g: strong(FourierMask(1, generator=g), 4),
}


class TestFourierMask(BaseTester):
    @pytest.mark.parametrize("size", [23, 64, (24, 36)])
    def test_feature_holds_no_frequency_above_the_highest(self, size):
        phase = FourierMask(2, size, max_frequency=4).phase.detach().double().numpy()
        rows, columns = phase.shape[1:]
        transform = np.abs(np.fft.fft2(phase)) / phase[0].size
        beyond = np.zeros((rows, columns), bool)
        beyond |= (np.abs(np.fft.fftfreq(rows, 1 / rows)) > 4)[:, None]
        beyond |= np.abs(np.fft.fftfreq(columns, 1 / columns)) > 4
        assert transform[:, beyond].max() < 1e-6
        assert transform[:, ~beyond].max() > 0.05

    def test_feature_spans_every_surface_of_these_frequencies(self):
        basis = FourierMask(initial=torch.eye(49).reshape(49, 7, 7), max_frequency=3).phase.detach().flatten(1).double()
        self.assert_close(basis @ basis.T / 529, torch.eye(49).double(), rtol=0, atol=1e-5)

    @pytest.mark.parametrize("frequency", [0, 12])
    def test_exception_frequency(self, frequency):
        with pytest.raises(ValueError, match="max_frequency must be"):
            FourierMask(max_frequency=frequency)
