"""Energies of many waves, by the waves and by the mutual intensity, against complex products written out."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.kernels.build import compiled
from kornia_tidy.psf import energies
from kornia_tidy.psf.energies import (
    LARGEST_WINDOW,
    SOURCE,
    energy_operations,
    mutual_energies,
    pixel_energies,
    wave_energies,
)
from tests.base import BaseTester
from tests.psf.energies_tester import EnergiesTester, random_case, round_off


@pytest.fixture(params=[1, 700, 2**20], ids=["rows and single depths", "single depths", "all at once"])
def block(request, monkeypatch):
    monkeypatch.setattr(energies, "_BLOCK_NUMBERS", request.param)
    monkeypatch.setattr(energies, "_BLOCK_SAMPLES", request.param)


@pytest.mark.usefixtures("block")
class TestWaveEnergies(EnergiesTester):
    energies = staticmethod(wave_energies)


@pytest.mark.usefixtures("block")
class TestMutualEnergies(EnergiesTester):
    energies = staticmethod(mutual_energies)


@pytest.mark.usefixtures("block")
class TestMutualEnergiesWithoutCompiler(EnergiesTester):
    energies = staticmethod(mutual_energies)

    @pytest.fixture(autouse=True)
    def no_compiler(self, monkeypatch):
        monkeypatch.setattr(energies, "goes_in_c", lambda *_: False)


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
        got = mutual_energies(field, weights, kernels)
        expected = mutual_energies(field, weights.requires_grad_(), kernels).detach()  # not in C
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


class TestNumerics(BaseTester):
    def test_feature_no_pixel_has_less_than_no_light(self):
        """Opposite fields through equal kernels extinguish each other up to rounding, which has either sign."""
        half = torch.randn(3, 12, 6, dtype=torch.complex64)
        field = torch.cat([half, -half], -1)
        kernels = torch.randn(4, 9, 2, 6, dtype=torch.complex64).repeat(1, 1, 1, 2)
        got = mutual_energies(field, torch.ones(3), kernels)
        assert got.min() >= 0
        assert got.max() <= 1e-5 * mutual_energies(field[..., :6, :6], torch.ones(3), kernels[..., :6]).max()

    @pytest.mark.parametrize("limit", [1, 40, 100, 1000, 10**6])
    @pytest.mark.parametrize("shape", [(4, 5, 2, 7), (1, 3, 1, 2), (7, 1, 3, 2)])
    def test_property_every_row_of_every_depth_comes_once(self, shape, limit, monkeypatch):
        monkeypatch.setattr(energies, "_BLOCK_SAMPLES", limit)
        seen = torch.zeros(shape[:2])
        for depth, row in energies.wave_blocks(3, shape):
            seen[depth, row] += 1
        assert bool((seen == 1).all())

    def test_feature_memory_does_not_grow_with_depths_and_states(self):
        """The waves of a single pixel row are the most that is held, where they exceed the block."""
        for depth, row in energies.wave_blocks(16, (21, 129, 6, 23)):
            assert (depth.stop - depth.start) * (row.stop - row.start) * 6 * 16 * 2 * 129 * 6 <= 2**18


class TestChoice(BaseTester):
    @pytest.mark.parametrize(("states", "cells"), [(1, 46), (1, 12), (6, 4)])
    @pytest.mark.parametrize("in_c", [True, False])
    def test_feature_the_way_with_fewer_operations_is_taken_where_those_in_c_count_less(
        self, states, cells, in_c, monkeypatch
    ):
        monkeypatch.setattr(energies, "goes_in_c", lambda *_: in_c and compiled(SOURCE, torch.float32) is not None)
        case = random_case(states, cells, 2, 5, 2)
        by_waves, by_intensity = energy_operations(states, 5, 2, cells)
        assert by_intensity / by_waves == pytest.approx({46: 2.98, 12: 1.94, 4: 0.70}[cells], abs=0.01)
        mutual = states == 6 or (energies.goes_in_c() and cells == 12)
        taken = mutual_energies if mutual else wave_energies
        assert torch.equal(pixel_energies(*case), taken(*case))
