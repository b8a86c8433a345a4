"""Random masks by the name of their family."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.choices import MASK_FAMILIES
from kornia_tidy.masks.families import random_masks
from tests.base import BaseTester


class TestRandomMasks(BaseTester):
    @pytest.mark.parametrize("family", MASK_FAMILIES)
    def test_cardinality(self, family):
        masks = random_masks(family, 3)
        assert len(masks.phase) == (1 if family == "none" else 3)

    @pytest.mark.parametrize("family", sorted(set(MASK_FAMILIES) - {"none"}))
    def test_feature_the_generator_alone_determines_them(self, family):
        first, again, other = (random_masks(family, 2, torch.Generator().manual_seed(s)).phase for s in (1, 1, 2))
        assert torch.equal(first, again)
        assert not torch.equal(first, other)
        assert not torch.equal(first[0], first[1])

    def test_exception_names_the_families(self):
        with pytest.raises(ValueError, match=r"family must be .*'spiral'.*, got 'lens'"):
            random_masks("lens")

    def test_exception_no_masks(self):
        with pytest.raises(ValueError, match="got 0"):
            random_masks("spiral", 0)
