from __future__ import annotations

import math

import torch

from kornia_tidy import FresnelLens
from tests.base import BaseTester

ONE_MASK = {"Fresnel": lambda g: FresnelLens(), "strong Fresnel": lambda g: FresnelLens(40.0)}


class TestFresnelLens(BaseTester):
    def test_feature_equals_defocus_up_to_whole_waves(self):
        lens = FresnelLens(defocus=10.0)
        x = (torch.arange(23) - 11) * 0.1
        difference = torch.remainder(lens.phase[0] - 10 * (x[:, None] ** 2 + x**2) + 0.5, 2 * math.pi) - 0.5
        assert float(difference.abs().max()) < 1e-5

    def test_feature_is_not_learnable_but_travels(self):
        lens = FresnelLens()
        assert list(lens.parameters()) == []
        assert "phase" in lens.state_dict()
