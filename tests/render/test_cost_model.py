from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest

from kornia_tidy.render.cost_model import (
    BankWork,
    DenseOcclusionWork,
    DenseWork,
    DirectOcclusionWork,
    DirectWork,
    OverlapWork,
    TiledOcclusionWork,
    TiledWork,
    seconds_of,
)
from kornia_tidy.render.cost_profile import EPYC, RATES, XEON, CostProfile, DirectRates, TiledRates
from tests.base import BaseTester

WORKS = (
    DirectWork(pixels=2**18, strips=2**13, psf_size=23),
    TiledWork(size=72, blocks=64, pairs=200, layers=7, pixels=2**18, blended=2),
    OverlapWork(size=96, blocks=64, pairs=200, layers=7, pixels=2**18, blended=2),
    DenseWork(height=600, width=534, layers=7, pixels=2**18, blended=1),
    DirectOcclusionWork(pixels=2**18, alone=500, pairs=4000, columns=10**6, edges=10**5, psf_size=23, layers=7),
    TiledOcclusionWork(size=64, windows=(0, 20, 30, 10), pixels=2**18),
    DenseOcclusionWork(height=600, width=534, layers=7, pixels=2**18),
    BankWork(products=1e9, intensities=1e8),
)
RENDERING = WORKS[:-1]


def named(works):
    return pytest.mark.parametrize("work", works, ids=lambda work: work.rates)


class TestSeconds(BaseTester):
    @named(WORKS)
    def test_cardinality_a_price_for_each_term(self, work):
        for profile in (XEON, EPYC):
            assert len(work.terms) == len(getattr(profile, work.rates).nanoseconds)
            assert seconds_of(work, profile) > 0
        assert {one.rates for one in WORKS} == set(RATES)

    def test_feature_direct_work_on_the_xeon_by_hand(self):
        """70 + 0.95 P^2 nanoseconds for each strip, layer and channel."""
        seconds = seconds_of(DirectWork(10**6, 29_650, 23, channels=3), XEON)
        assert seconds == pytest.approx(3e-9 * 29_650 * (70 + 0.95 * 23**2))

    def test_feature_tiles_by_hand(self):
        """Transforms of blocks, pairs back and PSFs; 2 log2 n factors of two a sample."""
        rates = replace(EPYC.tiled, call=0, pixel=0, blended=0, block=0, pair=0, large=0, step=0, transform=1)
        work = TiledWork(size=64, blocks=5, pairs=9, layers=2, pixels=100, blended=1)
        assert rates.seconds(work.terms) == pytest.approx(1e-9 * 64**2 * 12 * (5 + 9 + 2))

    @named(RENDERING)
    def test_feature_grows_with_channels(self, work):
        one, three = (seconds_of(replace(work, channels=channels), EPYC) for channels in (1, 3))
        assert one < three <= 3 * one * (1 + 1e-12)

    @named([work for work in RENDERING if hasattr(work, "itemsize")])
    def test_feature_float64_takes_up_to_twice_as_long_for_the_same_counts(self, work):
        one, two = (seconds_of(replace(work, itemsize=itemsize), EPYC) for itemsize in (4, 8))
        assert one < two <= 2.2 * one

    @named(WORKS)
    def test_feature_threads_share_all_but_what_is_paid_once(self, work):
        rates = replace(getattr(EPYC, work.rates), shared=0.75)
        once = 1e-9 * rates.nanoseconds[0]
        one, four = (rates.seconds(work.terms, threads) - once for threads in (1, 4))
        assert four == pytest.approx(one * (0.25 + 0.75 / 4))

    def test_feature_dense_planes_of_odd_factors_take_longer_than_their_samples_say(self):
        """620 px are transformed as 625, which has no factor of two, 640 as they are."""
        odd, even = (DenseWork(side, side, 3, 1, 1) for side in (620, 640))
        of_transforms = replace(EPYC.dense, call=0, pixel=0, product=0, blended=0)
        each = [of_transforms.seconds(work.terms) / side**2 for work, side in ((odd, 625), (even, 640))]
        assert each[0] > 1.1 * each[1]

    def test_feature_windows_of_several_layers_cost_more_the_more_they_hold(self):
        few, many = (TiledOcclusionWork(64, (0, 0, 40, 0, 0)), TiledOcclusionWork(64, (0, 0, 0, 0, 40)))
        assert 2 < seconds_of(many, XEON) / seconds_of(few, XEON) < 3

    def test_feature_large_planes_cost_more_a_sample(self):
        small, large = (TiledWork(size, 1, 21, 21, 1, 1) for size in (64, 512))
        only = replace(EPYC.tiled, call=0, pixel=0, blended=0, transform=0, block=0, step=0)
        assert only.seconds(large.terms) > 64 * 1.5 * only.seconds(small.terms)


class TestProfile(BaseTester):
    @pytest.mark.parametrize("profile", [XEON, EPYC], ids=lambda profile: profile.name)
    def test_feature_json_and_back(self, profile):
        assert CostProfile.from_json(profile.as_json()) == profile

    def test_feature_scaling_is_of_the_named_backends(self):
        slow = EPYC.scaled("slow", {"direct": 2.0, "dense": 0.5})
        assert slow.name == "slow"
        for work in WORKS:
            factor = {"direct": 2.0, "dense": 0.5}.get(work.rates, 1.0)
            assert seconds_of(work, slow, 3) == pytest.approx(factor * seconds_of(work, EPYC, 3))

    @pytest.mark.parametrize(
        ("key", "number"), [("shared", 1.5), ("strip", -1.0), ("strip", math.nan), ("strip", "7"), ("strip", True)]
    )
    def test_exception_numbers_that_are_no_times(self, key, number):
        document = EPYC.as_json()
        document["direct"][key] = number
        with pytest.raises(ValueError, match=rf"direct\.{key} of a cost profile must be a finite number"):
            CostProfile.from_json(document)

    @pytest.mark.parametrize("document", [[], {}, {**EPYC.as_json(), "more": 1}, {**EPYC.as_json(), "name": 1}])
    def test_exception_documents_that_are_no_profile(self, document):
        with pytest.raises(ValueError, match=r"of a cost profile|a cost profile has"):
            CostProfile.from_json(document)

    def test_exception_rates_that_are_incomplete(self):
        document = EPYC.as_json()
        del document["tiled"]["pair"]
        with pytest.raises(ValueError, match="tiled of a cost profile has the numbers shared, call"):
            CostProfile.from_json(document)

    def test_cardinality_the_first_rate_is_paid_once(self):
        for kind in (DirectRates, TiledRates, *RATES.values()):
            assert [field.name for field in fields(kind)][:2] == ["shared", "call"]
