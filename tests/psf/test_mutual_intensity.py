"""Energies by the mutual intensity against waves written out."""

from __future__ import annotations

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from kornia_tidy.kernels.build import compiled
from kornia_tidy.psf import mutual_intensity
from kornia_tidy.psf.mutual_intensity import LARGEST_WINDOW, SOURCE, mutual_energies
from kornia_tidy.psf.propagation import energy_operations, pixel_energies
from kornia_tidy.psf.wave_energy import wave_energies
from tests.base import BaseTester
from tests.psf.energies import EnergiesTester, random_case, round_off


@pytest.fixture(params=[1, 2**20], ids=["single depths", "all at once"])
def block_numbers(request, monkeypatch):
    monkeypatch.setattr(mutual_intensity, "_BLOCK_NUMBERS", request.param)


@pytest.mark.usefixtures("block_numbers")
class TestMutualEnergies(EnergiesTester):
    energies = staticmethod(mutual_energies)


@pytest.mark.skipif(compiled(SOURCE, torch.float32) is None, reason="no C compiler on this machine")
class TestInC(BaseTester):
    """What C makes of it, against the matrix products that energies go through without a compiler."""

    @pytest.mark.parametrize(("states", "cells", "order"), [(1, 5, 1), (5, 23, 3), (3, 16, 2), (2, 33, 4)])
    @pytest.mark.parametrize("window", [1, 7, 22, LARGEST_WINDOW])
    def test_feature_equals_the_matrix_products(self, states, cells, order, window, dtype):
        """Both are within the round-off of their formula. That is wide in float32, but both types are one source."""
        complex_type = dtype.to_complex()
        field = torch.randn(states, cells, cells, dtype=complex_type)
        kernels = torch.randn(3, window, order, cells, dtype=complex_type)
        weights = torch.rand(states, dtype=dtype)
        allowed = 2 * round_off(field, weights, kernels)
        expected = mutual_intensity._energies(*mutual_intensity._matrices(field, weights, kernels))
        got = mutual_energies(field, weights, kernels)
        assert bool(((got.double() - expected.double()).abs() <= allowed).all())
        assert bool((allowed < (0.1 if dtype == torch.float32 else 1e-9) * expected.max()).all())

    def test_feature_any_memory_order_and_number_of_threads(self):
        field, weights = torch.randn(2, 8, 8, dtype=torch.complex64), torch.rand(2)
        kernels = torch.randn(2, 9, 5, 8, dtype=torch.complex64).transpose(1, 2)
        expected, threads = (
            mutual_energies(field.mT.contiguous().mT.conj().conj(), weights, kernels),
            torch.get_num_threads(),
        )
        try:
            torch.set_num_threads(3)
            assert torch.equal(mutual_energies(field, weights, kernels.contiguous()), expected)
            got = mutual_energies(field.conj(), weights, kernels.conj())  # in memory they are not conjugated
        finally:
            torch.set_num_threads(threads)
        self.assert_close(got, expected, rtol=1e-5, atol=1e-4)

    def test_feature_for_small_windows_and_the_gradient_of_the_field_alone(self, monkeypatch):
        taken = []
        for name in ("mutual_intensity_energies", "mutual_field_gradient"):
            function = getattr(mutual_intensity, name)
            monkeypatch.setattr(
                mutual_intensity, name, lambda *x, n=name, f=function: taken.append((n, x[2].shape[1])) or f(*x)
            )
        for window in (9, LARGEST_WINDOW + 2):
            field, kernels = (torch.randn(*shape, dtype=torch.complex64) for shape in ((2, 8, 8), (2, window, 2, 8)))
            weights = torch.ones(2)
            mutual_energies(field.requires_grad_(), weights, kernels).sum().backward()
            mutual_energies(field, weights.requires_grad_(), kernels).sum().backward()
        energies, gradient = ("mutual_intensity_energies", 9), ("mutual_field_gradient", 9)
        assert taken == [energies, gradient, energies]


class TestOperator(BaseTester):
    @pytest.mark.parametrize("learning", [False, True])
    def test_dynamo_passes_the_checks_of_operators(self, learning):
        """Schema, fake tensors of any shape, gradients as registered, and the compiler's dispatch."""
        case = [x.requires_grad_(learning) for x in random_case()]
        torch.library.opcheck(torch.ops.kornia_tidy.mutual_energies.default, (*case,))

    @pytest.mark.parametrize("wanted", [[True, True, True], [False, True, False], [True, False, False]])
    def test_dynamo_the_gradients_pass_the_checks_of_operators(self, wanted):
        case = random_case()
        light = torch.randn(4, 5, 5, dtype=torch.float64)
        torch.library.opcheck(torch.ops.kornia_tidy.mutual_energies_gradients.default, (*case, light, wanted))

    def test_dynamo_equals_eager_to_the_last_bit(self):
        case = [x.requires_grad_() for x in random_case()]
        compiled = torch.compile(mutual_energies, fullgraph=True, backend="aot_eager")
        results = []
        for energies in (mutual_energies, compiled):
            got = energies(*case)
            results.append((got, *torch.autograd.grad(got.square().sum(), case)))
        for expected, got in zip(*results, strict=True):
            assert torch.equal(expected, got)
        with torch.no_grad():
            assert torch.equal(compiled(*case), mutual_energies(*case))

    def test_feature_gradients_are_the_same_while_operations_are_counted(self):
        """A dispatch mode has torch call operators with autograd and conjugation switched off."""
        case = [x.requires_grad_() for x in random_case()]
        expected = torch.autograd.grad(mutual_energies(*case).square().sum(), case)
        with FlopCounterMode(display=False):
            got = torch.autograd.grad(mutual_energies(*case).square().sum(), case)
        for one, other in zip(expected, got, strict=True):
            assert torch.equal(one, other)


class TestNumerics(BaseTester):
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
