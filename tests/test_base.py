"""What tests need of ../shared: where a part is missing they skip and name it."""

from __future__ import annotations

import json

import pytest
import torch

from tests import base, scenes
from tests.base import BaseTester, oracle, shared
from tests.rounding import gamma


@pytest.fixture
def part_of_shared(tmp_path, monkeypatch):
    """A ../shared that holds one picture of one scene, without its depth."""
    monkeypatch.setattr(base, "SHARED", tmp_path)
    entry = {"name": "street", "image": "rgbd/street.png", "depth": "rgbd/street.pfm"}
    (tmp_path / "data/rgbd").mkdir(parents=True)
    (tmp_path / "data/scenes.json").write_text(json.dumps([entry]))
    (tmp_path / "data/rgbd/street.png").write_bytes(b"")
    monkeypatch.setattr(scenes, "ENTRIES", {"street": entry})
    return tmp_path


class TestShared(BaseTester):
    def test_feature_what_is_there_is_returned(self, part_of_shared):
        assert shared("data/rgbd/street.png") == part_of_shared / "data/rgbd/street.png"
        assert shared("data/rgbd", {"*.png": 1}) == part_of_shared / "data/rgbd"

    @pytest.mark.usefixtures("part_of_shared")
    def test_exception_what_is_missing_skips_and_is_named(self):
        for ask, sentence in (
            (lambda: shared("data/masks/a.txt"), r"^\.\./shared/data/masks/a\.txt is not on this machine$"),
            (lambda: shared("data/rgbd", {"*.png": 3}), r"^\.\./shared/data/rgbd has 1 of 3 files \*\.png on this"),
            (oracle.__wrapped__, r"^\.\./shared/oracle/oracle\.py is not on this machine$"),
            (lambda: scenes.load_scene("street"), r"^\.\./shared/data/rgbd/street\.pfm is not on this machine$"),
        ):
            with pytest.raises(pytest.skip.Exception, match=sentence):
                ask()

    @pytest.mark.usefixtures("part_of_shared")
    def test_exception_a_scene_that_is_not_listed_skips(self):
        with pytest.raises(pytest.skip.Exception, match=r"^\.\./shared/data/scenes\.json does not list lane$"):
            scenes.load_scene("lane")


class TestRounding(BaseTester):
    @pytest.mark.parametrize("count", [10, 1000])
    def test_feature_sums_of_products_keep_their_bound(self, count, dtype):
        """In any order, against float64 or, for it, sums of whole numbers that are exact."""
        one, two = torch.randint(-(2**20), 2**20, (2, 8, count)).to(dtype)
        exact = (one.double() * two.double()).sum(-1)  # below 2**53
        allowed = gamma(count, dtype) * (one.abs().double() * two.abs().double()).sum(-1)
        for order in (torch.arange(count), torch.randperm(count)):
            total = torch.zeros(8, dtype=dtype)
            for index in order:
                total = total + one[:, index] * two[:, index]
            assert bool(((total.double() - exact).abs() <= allowed).all())
