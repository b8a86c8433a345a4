"""Energies by the mutual intensity against waves written out."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.optics import mutual_intensity
from kornia_tidy.optics.mutual_intensity import mutual_energies
from kornia_tidy.optics.propagation import energy_operations, pixel_energies
from kornia_tidy.optics.wave_energy import wave_energies
from tests.base import BaseTester
from tests.optics.energies import EnergiesTester, random_case


@pytest.fixture(params=[1, 2**20], ids=["single depths", "all at once"])
def block_numbers(request, monkeypatch):
    monkeypatch.setattr(mutual_intensity, "_BLOCK_NUMBERS", request.param)


@pytest.mark.usefixtures("block_numbers")
class TestMutualEnergies(EnergiesTester):
    energies = staticmethod(mutual_energies)


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
