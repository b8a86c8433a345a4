"""Real matrix products against complex ones written out."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.psf import wave_energy
from kornia_tidy.psf.wave_energy import wave_energies
from tests.base import BaseTester
from tests.psf.energies import EnergiesTester


@pytest.fixture(params=[1, 700, 2**18], ids=["pixel rows", "single depths", "all at once"])
def block_samples(request, monkeypatch):
    monkeypatch.setattr(wave_energy, "_BLOCK_SAMPLES", request.param)


@pytest.mark.usefixtures("block_samples")
class TestWaveEnergies(EnergiesTester):
    energies = staticmethod(wave_energies)


class TestBlocks(BaseTester):
    @pytest.mark.parametrize("limit", [1, 40, 100, 1000, 10**6])
    @pytest.mark.parametrize("shape", [(4, 5, 2, 7), (1, 3, 1, 2), (7, 1, 3, 2)])
    def test_property_every_row_of_every_depth_comes_once(self, shape, limit, monkeypatch):
        monkeypatch.setattr(wave_energy, "_BLOCK_SAMPLES", limit)
        seen = torch.zeros(shape[:2])
        for depth, row in wave_energy._blocks(3, shape):
            seen[depth, row] += 1
        assert bool((seen == 1).all())

    def test_feature_memory_does_not_grow_with_depths_and_states(self):
        """The waves of a single pixel row are the most that is held, where they exceed the block."""
        for depth, row in wave_energy._blocks(16, (21, 129, 6, 23)):
            assert (depth.stop - depth.start) * (row.stop - row.start) * 6 * 16 * 2 * 129 * 6 <= 2**18
