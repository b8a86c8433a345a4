"""The network for any camera: what it adds to the closed form, and where its weights come from."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import AnyCameraHead
from kornia_tidy.reconstruction.any_camera import MOST, beside_clipped, largest_share
from tests.base import BaseTester
from tests.reconstruction.test_closed_form import bank, photo


def head_of(dtype=torch.float32, *, trained=False):
    torch.manual_seed(0)
    head = AnyCameraHead(width=2, repeats=1).eval().to(dtype)
    head.closed_form.set_psfs(bank(7, dtype=dtype))
    if trained:
        generator = torch.Generator().manual_seed(1)
        for parameter in head.network.parameters():
            if not parameter.any() or parameter is head.network.last.bias:
                torch.nn.init.normal_(parameter, std=0.05, generator=generator)
        torch.nn.init.normal_(head.network.last.weight, std=0.02, generator=generator)
    return head


def share_of(head, capture, noise):
    return largest_share(head.closed_form, head.closed_form.settings_of(capture, noise))


class TestAnyCameraHead(BaseTester):
    def test_cardinality(self):
        for size in [(33, 31), (1, 50), (1, 1)]:
            assert head_of()(photo(*size, dtype=torch.float32)).shape == (2, 3, *size)

    def test_feature_a_share_of_zero_is_the_closed_form_and_of_one_the_whole_correction(self):
        head, capture = head_of(torch.float64, trained=True), photo(32, 32)
        with torch.no_grad():
            restored = head.closed_form(capture, 0.01)
            head.network.last.weight[0] = 0
            found = []
            for logit in (-50.0, 50.0):
                head.network.last.bias[0] = logit
                found.append(head(capture, 0.01))
            correction = head.network(restored.maps)[:, 1:]
            correction = share_of(head, capture, 0.01) * correction
        self.assert_close(found[0], restored.image)
        self.assert_close(found[1], restored.image + correction)
        assert correction.abs().max() > 1e-3

    def test_feature_the_share_rises_beside_clipped_pixels_alone(self):
        capture = torch.full((1, 3, 16, 64), 0.5)
        capture[:, 1, :, 40:] = 1.0
        share = beside_clipped(torch.full((1, 1, 1, 1), 0.3), capture)
        assert share.shape == (1, 1, 16, 64)
        self.assert_close(share[..., :32], torch.full((1, 1, 16, 32), 0.3))
        assert (share[..., 36:44].diff() >= 0).all()
        assert 0.6 < float(share[..., 39].mean()) < float(share.max()) <= MOST
        whole = torch.full((1, 1, 1, 1), MOST)
        self.assert_close(beside_clipped(whole, capture), whole.expand_as(share))  # which is the most there is

    def test_feature_the_less_there_is_to_correct_the_smaller_is_the_share(self):
        """Noise of a thousandth, and of a tenth, behind PSFs that hardly blur."""
        head = head_of(torch.float64)
        psfs = torch.zeros(7, 3, 5, 5, dtype=torch.float64)
        psfs[..., 2, 2] = 1
        head.closed_form.set_psfs(PSFBank.from_measured(psfs, torch.arange(7.0, dtype=torch.float64)))
        capture = torch.rand(1, 3, 32, 32, dtype=torch.float64)
        small, large = (share_of(head, capture, noise) for noise in (0.001, 0.1))
        assert 0 <= small < 0.1
        assert large == MOST

    def test_feature_the_softer_the_scene_the_smaller_is_the_share(self):
        """Beyond a sixteenth of the detail of photographs it does not change."""
        head, random = head_of(torch.float64), torch.rand(1, 3, 64, 64, dtype=torch.float64)
        soft, sharp, sharper = (share_of(head, 0.5 + contrast * (random - 0.5), 1e-4) for contrast in (1e-3, 0.5, 1.0))
        assert 0 < soft < 0.5 * sharp
        assert sharp == sharper

    def test_exception_no_psfs(self):
        with pytest.raises(ValueError, match="the closed form does not know its camera"):
            AnyCameraHead(width=2)(photo(16, 16, dtype=torch.float32))
