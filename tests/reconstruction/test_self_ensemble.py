"""Means over orientations of what a network sees."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction import (
    JointClosedFormHead,
    JointHead,
    MiDaSSmall,
    NAFNet,
    SelfEnsemble,
    closed_form_channels,
    self_ensemble,
)
from kornia_tidy.reconstruction.heads import PlainHead
from kornia_tidy.reconstruction.self_ensemble import ORIENTATIONS
from tests.base import BaseTester
from tests.reconstruction.test_closed_form import bank, photo
from tests.reconstruction.test_closed_form_head import head_of, small

# The symmetries of a square, as NumPy turns arrays (H, W, C).
SQUARE = [(turns, mirrored) for mirrored in (False, True) for turns in range(4)]


def turned(array, turns, mirrored):
    array = np.rot90(array, turns)
    return np.fliplr(array) if mirrored else array


def turned_back(array, turns, mirrored):
    return np.rot90(np.fliplr(array) if mirrored else array, -turns)


def network(dtype=torch.float32):
    torch.manual_seed(1)
    return PlainHead(3, 2, width=4).eval().to(dtype)


def numpy_mean(net, image, orientations):
    """The definition, in NumPy."""
    found = []
    for turns, mirrored in orientations:
        array = np.ascontiguousarray(turned(image.permute(1, 2, 0).numpy(), turns, mirrored))
        with torch.no_grad():
            maps = net(torch.from_numpy(array).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
        found.append(turned_back(maps, turns, mirrored))
    return torch.from_numpy(np.mean(found, 0)).permute(2, 0, 1)


class TestSelfEnsemble(BaseTester):
    @pytest.mark.parametrize("orientations", ORIENTATIONS)
    def test_feature_is_the_mean_of_its_definition(self, orientations):
        net, image = network(torch.float64), torch.rand(3, 24, 40, dtype=torch.float64)
        chosen = {1: SQUARE[:1], 2: SQUARE[:3:2], 4: SQUARE[:4], 8: SQUARE}[orientations]
        with torch.no_grad():
            found = SelfEnsemble(net, orientations)(image[None])[0]
        self.assert_close(found, numpy_mean(net, image, chosen))

    def test_gradcheck(self):
        net = network(torch.float64)
        self.gradcheck(SelfEnsemble(net, 8), (torch.rand(1, 3, 4, 6, dtype=torch.float64),))

    def test_exception(self):
        with pytest.raises(ValueError, match="orientations must be one of 1, 2, 4, 8, got 3"):
            SelfEnsemble(network(), 3)
        whole = network()
        whole.whole_image = True
        with pytest.raises(ValueError, match="PlainHead sees the whole image, and cannot be turned"):
            SelfEnsemble(whole)


class TestSelfEnsembleOfAHead(BaseTester):
    def test_feature_only_what_the_network_adds_is_averaged(self):
        head, capture = head_of(small(), trained=True, dtype=torch.float64), photo(32, 48)
        with torch.no_grad():
            restored = head.closed_form(capture, 0.01)
            expected = restored.image + SelfEnsemble(head.network)(restored.maps)
            self.assert_close(self_ensemble(head)(capture, 0.01), expected)

    def test_feature_the_head_stays_as_it_is_and_shares_its_weights(self):
        head, capture = head_of(small(), trained=True), photo(32, 48, dtype=torch.float32)
        with torch.no_grad():
            before = head(capture, 0.01)
            ensemble = self_ensemble(head, 2)
            assert torch.equal(head(capture, 0.01), before)
            assert torch.equal(self_ensemble(head, 1)(capture, 0.01), before)
        assert {id(each) for each in ensemble.parameters()} == {id(each) for each in head.parameters()}
        ensemble.closed_form.set_psfs(bank(5, dtype=torch.float32))  # of its own
        with torch.no_grad():
            assert torch.equal(head(capture, 0.01), before)

    def test_feature_both_networks_of_a_joint_head_are_averaged(self):
        torch.manual_seed(0)
        first = NAFNet(closed_form_channels(4, likelihood=True), 6 + 3, width=2)
        refiner = NAFNet(closed_form_channels(4), 3, width=2)
        head = JointClosedFormHead(first, 4, refiner).eval()
        head.closed_form.set_psfs(bank(4, dtype=torch.float32))
        for parameter in head.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.02)
        capture = photo(32, 48, dtype=torch.float32)
        ensemble = self_ensemble(JointHead(head), 4)
        parts = [part for part in ensemble.modules() if isinstance(part, SelfEnsemble)]
        assert [part.network.out_channels for part in parts] == [9, 3]
        with torch.no_grad():
            alone, averaged = JointHead(head)(capture), ensemble(capture)
        for one, other in zip(alone, averaged, strict=True):
            assert (one - other).abs().max() > 1e-4

    def test_exception(self):
        with pytest.raises(ValueError, match="begins with the closed form, and MiDaSSmall has none"):
            self_ensemble(MiDaSSmall(out_channels=1))
        with pytest.raises(ValueError, match="orientations=2 is for a network that begins with the closed form"):
            self_ensemble(head_of(None), 2)
        with pytest.raises(ValueError, match="one of 1, 2, 4, 8, got 0"):
            self_ensemble(head_of(small()), 0)
