"""Seeds by keys."""

from __future__ import annotations

from kornia_tidy.seeds import keyed_seed
from tests.base import BaseTester


class TestKeyedSeed(BaseTester):
    def test_feature_keys_do_not_run_together(self):
        seeds = {keyed_seed(*keys) for keys in ((1, 2), (12,), (2, 1), ("1", "", "2"), (1,), (0, 1, 2))}
        assert len(seeds) == 6
        assert all(0 <= seed < 2**63 for seed in seeds)
