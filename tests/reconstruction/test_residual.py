"""Networks that add to the capture."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.reconstruction import AttentionUNet, PhaseCam3DUNet, Residual
from kornia_tidy.reconstruction.heads import PlainHead
from tests.base import BaseTester


class TestResidual(BaseTester):
    @pytest.mark.parametrize("make", [AttentionUNet, PlainHead])
    @pytest.mark.parametrize("maps", [3, 4])
    def test_smoke_begins_as_the_identity(self, make, maps, device, dtype):
        head = Residual(make(out_channels=maps, width=4)).to(device, dtype).eval()
        image = torch.rand(2, 3, 21, 40, device=device, dtype=dtype)
        with torch.no_grad():
            output = head(image)
        assert output.shape == (2, maps, 21, 40)
        assert torch.equal(output[:, -3:], image)
        assert not output[:, :-3].any()

    def test_feature_adds_to_the_image_and_leaves_the_depth(self):
        head = Residual(PlainHead(3, 4, width=2))
        with torch.no_grad():
            head.network.layers[-1].bias.copy_(torch.tensor([1.0, 0.1, 0.2, 0.3]))
        image = torch.rand(1, 3, 8, 8)
        depth, estimate = head(image).split([1, 3], 1)
        assert (depth == 1).all()
        self.assert_close(estimate - image, torch.tensor([0.1, 0.2, 0.3]).view(1, 3, 1, 1).expand_as(image))

    @pytest.mark.parametrize(
        ("network", "sentence"),
        [
            (lambda: AttentionUNet(out_channels=1, width=2), "to 3 maps or more, AttentionUNet ends in Conv2d"),
            (lambda: PhaseCam3DUNet(out_channels=3, width=2), "PhaseCam3DUNet ends in Sigmoid"),
        ],
    )
    def test_exception_a_network_that_cannot_add(self, network, sentence):
        with pytest.raises(ValueError, match=sentence):
            Residual(network())
