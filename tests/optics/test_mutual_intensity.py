"""Energies by the mutual intensity against waves written out."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.optics import mutual_intensity
from kornia_tidy.optics.mutual_intensity import mutual_energies
from kornia_tidy.optics.propagation import energy_operations, pixel_energies
from kornia_tidy.optics.wave_energy import wave_energies
from tests.base import BaseTester
from tests.optics.test_wave_energy import random_case, written_out


@pytest.fixture(params=[1, 2**20], ids=["single depths", "all at once"])
def block_numbers(request, monkeypatch):
    monkeypatch.setattr(mutual_intensity, "_BLOCK_NUMBERS", request.param)


@pytest.mark.usefixtures("block_numbers")
class TestMutualEnergies(BaseTester):
    @pytest.mark.parametrize(("precision", "within"), [(torch.complex64, 1e-5), (torch.complex128, 1e-13)])
    def test_feature_equals_complex_products(self, precision, within):
        case = random_case(dtype=precision)
        expected = written_out(*(x.to(torch.complex128) if x.is_complex() else x.double() for x in case))
        got = mutual_energies(*case)
        assert got.dtype == case[1].dtype
        self.assert_close(got, expected, rtol=within, atol=0)

    def test_feature_gradients_equal_those_of_complex_products(self):
        case = tuple(x.requires_grad_() for x in random_case())
        light = torch.randn(4, 5, 5, dtype=torch.float64)
        ours, theirs = (
            torch.autograd.grad((function(*case) * light).sum(), case) for function in (mutual_energies, written_out)
        )
        for one, two in zip(ours, theirs, strict=True):
            self.assert_close(torch.view_as_real(one + 0j), torch.view_as_real(two + 0j), rtol=0, atol=1e-10)

    @pytest.mark.parametrize("wanted", [(0,), (1,), (2,)])
    def test_feature_each_gradient_can_be_had_alone(self, wanted):
        case = random_case()
        own = [case[i].requires_grad_() for i in wanted]
        ours, theirs = (
            torch.autograd.grad(function(*case).sum(), own)[0] for function in (mutual_energies, written_out)
        )
        self.assert_close(torch.view_as_real(ours + 0j), torch.view_as_real(theirs + 0j), rtol=0, atol=1e-10)

    def test_gradcheck_twice_in_field_weights_and_kernels(self):
        case = tuple(x.requires_grad_() for x in random_case(2, 3, 2, 3, 2))
        assert torch.autograd.gradcheck(mutual_energies, case, fast_mode=True)
        assert torch.autograd.gradgradcheck(mutual_energies, case, fast_mode=True)


class TestNumerics(BaseTester):
    def test_feature_autocast_changes_nothing(self):
        case = random_case(dtype=torch.complex64)
        case[0].requires_grad_()
        plain = mutual_energies(*case)
        (expected,) = torch.autograd.grad(plain.sum(), case[0])
        with torch.autocast("cpu", dtype=torch.bfloat16):
            cast = mutual_energies(*case)
            (got,) = torch.autograd.grad(cast.sum(), case[0])
        assert torch.equal(cast, plain)
        assert torch.equal(got, expected)

    def test_feature_a_state_that_is_never_shown_keeps_a_finite_gradient(self):
        field, _, kernels = random_case(2)
        weights = torch.tensor([1.0, 0.0], dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(mutual_energies(field, weights, kernels).sum(), weights)
        alone = mutual_energies(field[1:], torch.ones(1, dtype=torch.float64), kernels).sum()
        self.assert_close(gradient[1], alone)

    def test_feature_no_pixel_has_less_than_no_light(self):
        """Opposite fields through equal kernels extinguish each other up to rounding, which has either sign."""
        half = torch.randn(3, 12, 6, dtype=torch.complex64)
        field = torch.cat([half, -half], -1)
        kernels = torch.randn(4, 9, 2, 6, dtype=torch.complex64).repeat(1, 1, 1, 2)
        got = mutual_energies(field, torch.ones(3), kernels)
        assert got.min() >= 0
        assert got.max() <= 1e-5 * mutual_energies(field[..., :6, :6], torch.ones(3), kernels[..., :6]).max()

    def test_feature_memory_does_not_grow_with_depths(self):
        plain, left = torch.empty(46, 230), torch.empty(300, 61, 3, 46)
        slices = list(mutual_intensity._blocks(plain, left))
        assert [s.start for s in slices] == [0, *(s.stop for s in slices[:-1])]
        assert slices[-1].stop >= 300
        assert all((s.stop - s.start) * 61 * (2 * 3 * 230 + 23**2) <= 2**20 for s in slices)


class TestChoice(BaseTester):
    @pytest.mark.parametrize(("states", "cells"), [(1, 12), (6, 4)])
    def test_feature_the_way_with_fewer_operations_is_taken(self, states, cells):
        case = random_case(states, cells, 2, 5, 2)
        by_waves, by_intensity = energy_operations(states, 5, 2, cells)
        assert (by_intensity < by_waves) == (states == 6)
        taken = mutual_energies if states == 6 else wave_energies
        assert torch.equal(pixel_energies(*case), taken(*case))
