"""Convolution with large kernels, by transform and as it is exported."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from tests.base import BaseTester


def kernels(count=2, channels=3, side=5, dtype=torch.float64):
    return torch.rand(count, channels, side, side, dtype=dtype, generator=torch.Generator().manual_seed(0))


class TestConvolveKernels(BaseTester):
    def test_smoke(self, device, dtype):
        precise = torch.promote_types(dtype, torch.float32)
        image = torch.rand(2, 3, 11, 14, device=device, dtype=precise)
        assert convolve_kernels(image, kernels(dtype=precise).to(device)).dtype == precise

    @pytest.mark.parametrize("way", ["transform", "compiled", "vmap"])
    @pytest.mark.parametrize("size", [(12, 16), (11, 9), (2, 13), (1, 1)])
    def test_feature_convolves_each_channel_with_its_kernels(self, way, size):
        """By SciPy. A graph that is traced, and vmap, have the strided convolution."""
        image, taps = torch.rand(2, 3, *size, dtype=torch.float64), kernels()
        function = {
            "transform": convolve_kernels,
            "compiled": torch.compile(convolve_kernels, backend="eager"),
            "vmap": torch.vmap(lambda one, taps: convolve_kernels(one[None], taps)[0], in_dims=(0, None)),
        }[way]
        found = function(image, taps)
        assert found.shape == (2, 2, 3, *size)
        mode = "reflect" if min(size) > 2 else "edge"
        for b, d, c in np.ndindex(2, 2, 3):
            padded = np.pad(image[b, c].numpy(), 2, mode)
            self.assert_close(found[b, d, c], torch.from_numpy(convolve2d(padded, taps[d, c].numpy(), "valid")))

    def test_feature_nan_spreads_over_the_window_only(self):
        image = torch.rand(1, 1, 20, 24)
        image[0, 0, 10, 12] = torch.nan
        found = convolve_kernels(image, kernels(2, 1, 5, torch.float32))
        rows, columns = found[0, :, 0].isnan().any(0).nonzero().T
        assert (rows.min(), rows.max(), columns.min(), columns.max()) == (8, 12, 10, 14)
        assert int(found.isnan().sum()) == 2 * 5 * 5

    def test_gradcheck(self, device):
        image = torch.rand(1, 2, 7, 6, device=device, dtype=torch.float64)
        self.gradcheck(convolve_kernels, (image, kernels(2, 2, 3).to(device)))
