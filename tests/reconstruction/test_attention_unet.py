"""The attention U-Net against its published size and its gate written out in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction import AttentionUNet
from tests.base import BaseTester


def mixed(x, convolution, norm):
    """A 1x1 convolution and its normalisation, (C, H, W)."""
    weight, bias = convolution.weight.numpy()[:, :, 0, 0], convolution.bias.numpy()
    y = np.einsum("oc,chw->ohw", weight, x) + bias[:, None, None]
    mean, var, gain, shift = (
        v.numpy()[:, None, None] for v in (norm.running_mean, norm.running_var, norm.weight, norm.bias)
    )
    return (y - mean) / np.sqrt(var + 1e-5) * gain + shift


class TestAttentionUNet(BaseTester):
    @pytest.mark.parametrize(("outputs", "parameters"), [(1, 34_878_573), (3, 34_878_703), (4, 34_878_768)])
    def test_feature_the_published_number_of_parameters(self, outputs, parameters):
        with torch.device("meta"):
            head = AttentionUNet(out_channels=outputs)
        assert sum(p.numel() for p in head.parameters()) == parameters

    def test_feature_the_gate_is_its_formula(self):
        gate = AttentionUNet(width=4).double().eval().decoder[0].gate
        for parameter in gate.parameters():
            torch.nn.init.normal_(parameter)
        gate.requires_grad_(False)
        channels = gate.decoder[0].in_channels
        g, x = torch.randn(2, 1, channels, 3, 5, dtype=torch.float64)
        inner = np.maximum(mixed(g[0].numpy(), *gate.decoder) + mixed(x[0].numpy(), *gate.encoder), 0)
        weight = 1 / (1 + np.exp(-mixed(inner, *gate.weight[:2])))
        self.assert_close(gate(g, x)[0], torch.from_numpy(weight * x[0].numpy()), rtol=1e-12, atol=1e-12)
