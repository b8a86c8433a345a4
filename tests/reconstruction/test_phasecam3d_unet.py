"""PhaseCam3D's U-Net against its published layers and TensorFlow's transposed convolution written out."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction import PhaseCam3DUNet
from tests.base import BaseTester


class TestPhaseCam3DUNet(BaseTester):
    @pytest.mark.parametrize("outputs", [1, 4])
    def test_feature_the_published_layers_number_of_parameters(self, outputs):
        def unit(i, o, kernel=3):
            return kernel**2 * i * o + o + 2 * o  # convolution with bias, gain and shift of the normalisation

        channels = [32, 64, 128, 256, 512]
        down = sum(unit(i, o) + unit(o, o) for i, o in zip([3, *channels], channels, strict=False))
        up = sum(9 * 2 * c * c + unit(2 * c, c) + unit(c, c) for c in channels[:-1])
        with torch.device("meta"):
            head = PhaseCam3DUNet(out_channels=outputs)
        assert sum(p.numel() for p in head.parameters()) == down + up + unit(32, outputs, kernel=1)

    def test_feature_normalisation_is_tensorflows(self):
        """momentum=0.9 there weighs the old value, and is 0.1 here; epsilon is the default of tf.layers."""
        head = PhaseCam3DUNet(width=1)
        norms = [m for m in head.modules() if isinstance(m, torch.nn.BatchNorm2d)]
        assert len(norms) == 10 + 8 + 1
        assert {(m.eps, m.momentum) for m in norms} == {(1e-3, 0.1)}

    def test_feature_the_transposed_convolution_ends_as_same_does(self):
        level = PhaseCam3DUNet(width=1).double().decoder[0].requires_grad_(False)
        level.merge = torch.nn.Identity()
        x, weight = torch.randn(16, 3, 4, dtype=torch.float64), level.up.weight.numpy()
        expected = np.zeros((8, 7, 9))  # one more than twice the size, then cut at the end
        for (row, column), _ in np.ndenumerate(np.empty((3, 4))):
            cell = np.einsum("c,cokl->okl", x[:, row, column].numpy(), weight)
            expected[:, 2 * row : 2 * row + 3, 2 * column : 2 * column + 3] += cell
        skip = torch.randn(1, 8, 6, 8, dtype=torch.float64)
        out = level(x[None], skip)
        self.assert_close(out[0, :8], torch.from_numpy(expected[:, :6, :8]), rtol=1e-12, atol=1e-12)
        assert torch.equal(out[:, 8:], skip)

    def test_feature_outputs_lie_between_zero_and_one(self, device, dtype):
        head = PhaseCam3DUNet(width=2, out_channels=2).to(device, dtype)
        out = head.predict(100 * torch.randn(2, 3, 32, 32, device=device, dtype=dtype))
        assert 0 < out.min() < 0.5 < out.max() < 1
