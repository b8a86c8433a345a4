from __future__ import annotations

import pytest
import torch

from kornia_tidy import DefocusRange, DwellTimes, Fidelity, PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.psf.state_bank import StateBank
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=10.0)


def make(states=2, depths=3, veil=False):
    psfs = torch.rand(states, depths, 3, 5, 5) / 30
    energy = psfs.sum((-2, -1))
    return StateBank(
        psfs, torch.arange(float(depths)), energy, torch.full((states,), 1 / states), 1 - energy if veil else None
    )


class TestStateBank(BaseTester):
    @pytest.mark.parametrize("veil", [False, True])
    def test_smoke_iterates_over_banks_and_back(self, veil):
        bank = make(veil=veil)
        states = list(bank)
        assert len(bank) == len(states) == 2
        assert all(isinstance(state, PSFBank) for state in states)
        again = StateBank.of(states, bank.weights)
        assert torch.equal(again.psfs, bank.psfs)
        assert (again.veil is None) == (not veil)
        if veil:
            assert torch.equal(again.veil, bank.veil)

    def test_exception_names_the_shape_that_does_not_fit(self):
        bank = make()
        with pytest.raises(ValueError, match=r"weights must have shape \(2,\) as psfs have, got \(3,\)"):
            StateBank(bank.psfs, bank.defocus, bank.energy, torch.ones(3))
        with pytest.raises(ValueError, match=r"energy must have shape \(3, 3\) as psfs have, got \(2, 3\)"):
            StateBank(bank.psfs, bank.defocus, bank.energy[:, :2], bank.weights)


class TestStatesOfALens(BaseTester):
    @pytest.mark.parametrize(
        "fidelity", [SMALL.replace(stray_light="discard"), Fidelity.preset("paper")], ids=["exact", "paper"]
    )
    def test_feature_the_weighted_mean_of_the_states_is_the_bank(self, fidelity):
        optics = TiDyOptics(PixelwiseMask(3), DefocusRange(-10, 10), DwellTimes((1, 2, 5)), fidelity=fidelity)
        states, bank = optics.psf_bank(states=True), optics.psf_bank()
        assert states.psfs.shape == (3, *bank.psfs.shape)
        mean = torch.einsum("s,sdcyx->dcyx", states.weights, states.psfs)
        self.assert_close(mean, bank.psfs, rtol=1e-5, atol=1e-8)

    def test_feature_each_state_is_the_bank_of_its_mask_alone(self):
        masks = PixelwiseMask(3)
        states = TiDyOptics(masks, fidelity=SMALL).psf_bank(states=True)
        for height, state in zip(masks.heights().detach(), states, strict=True):
            alone = TiDyOptics(PixelwiseMask(initial=height[None]), fidelity=SMALL).psf_bank()
            self.assert_close(state.psfs, alone.psfs, rtol=1e-4, atol=1e-8)

    def test_feature_remembered_states_follow_the_masks(self):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=SMALL)
        with torch.no_grad():
            first = optics.psf_bank(states=True).psfs
            assert torch.equal(optics.psf_bank(states=True).psfs, first)
            optics.masks.phase[1] += torch.rand(23, 23)
            second = optics.psf_bank(states=True).psfs
        assert torch.equal(second[0], first[0])
        assert not torch.allclose(second[1], first[1])

    def test_gradients_reach_the_mask_of_the_state(self):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=SMALL)
        optics.psf_bank(states=True).psfs[1].square().sum().backward()
        assert optics.masks.phase.grad[0].abs().max() == 0
        assert optics.masks.phase.grad[1].abs().max() > 0
