from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy.training.coded_datasets import Layout
from tests.base import BaseTester


class TestLayout(BaseTester):
    @given(st.integers(1, 300), st.none() | st.integers(1, 60), st.integers(1, 5))
    def test_feature_however_shared_out_every_item_is_in_one_part(self, count, shard_items, world):
        parts = Layout(shard_items=shard_items).parts(count)
        items = sorted(i for rank in range(world) for part in parts[rank::world] for i in part.items)
        assert items == list(range(count))
        assert len({part.name for part in parts}) == len(parts)
        assert max(len(part.items) for part in parts) <= (shard_items or 1)

    def test_feature_names_sort_as_items_do(self):
        names = [part.name for part in Layout(shard_items=2).parts(25)]
        assert names == sorted(names)
        assert names[-1] == "00012.tar"
        assert [part.name for part in Layout().parts(2)] == ["000000", "000001"]

    def test_feature_what_lies_beside_has_one_order(self):
        assert Layout(beside=("mask", "image")) == Layout(beside=("image", "mask"))

    def test_exception_names_the_value(self):
        with pytest.raises(ValueError, match="must be one of 'image', 'depth', 'mask', got 'coded'"):
            Layout(beside=("coded",))
        with pytest.raises(ValueError, match="a shard must hold 1 item or more, got 0"):
            Layout(shard_items=0)
