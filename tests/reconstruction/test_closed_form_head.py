"""Networks that refine the closed form."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.reconstruction import (
    AttentionUNet,
    ClosedFormHead,
    NAFNet,
    PhaseCam3DUNet,
    closed_form_channels,
)
from kornia_tidy.reconstruction.closed_form_head import with_fine_maps
from kornia_tidy.reconstruction.heads import PlainHead
from tests.base import BaseTester
from tests.reconstruction.onnx_export import check_onnx
from tests.reconstruction.test_closed_form import bank, photo


def head_of(network, layers=0, dtype=torch.float32, *, trained=False, **options):
    head = ClosedFormHead(network, layers, **options).eval().to(dtype)
    head.closed_form.set_psfs(bank(layers or 4, dtype=dtype))
    if trained:
        generator = torch.Generator().manual_seed(1)
        for parameter in head.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.02, generator=generator)
    return head


def small(maps=3, layers=0):
    torch.manual_seed(0)
    return NAFNet(closed_form_channels(layers), maps, width=2)


class TestClosedFormHead(BaseTester):
    @pytest.mark.parametrize("kind", [NAFNet, AttentionUNet, PlainHead])
    @pytest.mark.parametrize("maps", [3, 4])
    def test_smoke_begins_as_the_closed_form(self, kind, maps):
        head = head_of(kind(closed_form_channels(5), maps, width=2), layers=5)
        capture = photo(32, 48, dtype=torch.float32)
        with torch.no_grad():
            output = head(capture, torch.tensor([0.002, 0.02]).view(2, 1, 1, 1))
            for sample, noise in enumerate((0.002, 0.02)):
                assert torch.equal(output[sample, -3:], head.closed_form(capture, noise).image[sample])
        assert not output[:, :-3].any()

    def test_feature_depth_is_estimated_by_the_network_alone(self):
        network = PlainHead(closed_form_channels(4), 1, width=2)
        head, capture = head_of(network, layers=4), photo(16, 16, dtype=torch.float32)
        with torch.no_grad():
            self.assert_close(head(capture), network(head.closed_form(capture).maps))

    def test_feature_a_network_that_is_given_fine_maps_makes_the_same_of_a_capture(self):
        plain = head_of(small(layers=4), layers=4, trained=True)
        fine = head_of(NAFNet(closed_form_channels(4, fine=True), 3, width=2), layers=4, fine=True)
        fine.load_state_dict(with_fine_maps(plain.state_dict(), fine))
        capture = photo(20, 24, dtype=torch.float32)
        with torch.no_grad():
            self.assert_close(fine(capture, 0.01), plain(capture, 0.01))
            first = fine.network.first.weight
            assert not first[:, -4:].any()
            first[:, -4:] += 0.1
            assert not torch.equal(fine(capture, 0.01), plain(capture, 0.01))
        with pytest.raises(ValueError, match="without fine maps must take 23 maps to be given them, got 27"):
            with_fine_maps(fine.state_dict(), fine)

    @pytest.mark.slow
    def test_feature_onnx_takes_capture_and_noise(self):
        head = head_of(PlainHead(closed_form_channels(4), 4, width=2), layers=4, trained=True)
        check_onnx(head, (photo(18, 21, dtype=torch.float32)[:1], torch.full((1, 1, 1, 1), 0.02)))

    def test_exception(self):
        with pytest.raises(ValueError, match="the network must take 21 channels, got in_channels=20"):
            ClosedFormHead(NAFNet(closed_form_channels(1), width=2), 1, fine=True)
        with pytest.raises(ValueError, match="the network must take 19 channels, got in_channels=3"):
            ClosedFormHead(NAFNet(width=2))
        with pytest.raises(ValueError, match="PhaseCam3DUNet ends in Sigmoid"):
            ClosedFormHead(PhaseCam3DUNet(closed_form_channels(), 3, width=2))
        with pytest.raises(ValueError, match="does not know its camera"):
            ClosedFormHead(small())(torch.rand(1, 3, 16, 16))
        with pytest.raises(ValueError, match="image must have 3 channels, got 4"):
            head_of(None)(torch.rand(1, 4, 8, 8))
