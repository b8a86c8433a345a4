from __future__ import annotations

import threading

import pytest
import torch

from kornia_tidy.render import cost_store, dispatch, first_use
from kornia_tidy.render.cost_model import seconds_of
from kornia_tidy.render.cost_profile import EPYC
from kornia_tidy.render.cost_store import StoredProfile, read_profile, shipped_profile, write_profile
from kornia_tidy.render.dispatch import BACKENDS, choose, refusal
from kornia_tidy.render.first_use import SMALL, measure_factors, profile_for
from kornia_tidy.render.scene_samples import sample_scene
from tests.base import BaseTester
from tests.render.test_cost_store import THREADS, cache  # noqa: F401

ABLE, ALL = ("direct", "overlap", "tiled", "dense"), tuple(BACKENDS.values())
LARGE = 4 * SMALL


@pytest.fixture
def times(cache, monkeypatch):  # noqa: F811
    """A machine on which direct takes six times as long as predicted, tiles half as long; and what was timed."""
    timed = []

    def take(backend, scene):
        timed.append(backend.name)
        factor = {"direct": 6.0, "overlap": 1.0, "tiled": 0.5, "dense": 1.0}[backend.name]
        return factor * seconds_of(backend.work(scene), shipped_profile(), torch.get_num_threads())

    monkeypatch.setattr(first_use, "time_rendering", take)
    return timed


needs_compiler = pytest.mark.skipif(
    refusal(BACKENDS["direct"], sample_scene(64, 5)) is not None, reason="no C compiler: nothing is rendered directly"
)


@needs_compiler
class TestProfileFor(BaseTester):
    @pytest.mark.parametrize("kind", ["gather", "occlusion"])
    def test_feature_backends_are_scaled_by_what_they_take(self, times, kind):
        profile = profile_for(kind, LARGE, ABLE, ALL)
        prefix = "" if kind == "gather" else "occlusion_"
        factors = {f"{prefix}direct": 6.0, f"{prefix}tiled": 0.5, f"{prefix}dense": 1.0}
        expected = shipped_profile().scaled(profile.name, factors)
        for key in factors:
            rates = getattr(profile, key).nanoseconds
            assert rates == pytest.approx(getattr(expected, key).nanoseconds)
        assert profile.name == f"{shipped_profile().name}, scaled on first use"
        assert read_profile(THREADS).measured == (kind,)

    def test_feature_it_is_measured_once(self, times):
        first = profile_for("gather", LARGE, ABLE, ALL)
        assert times
        times.clear()
        assert profile_for("gather", LARGE, ABLE, ALL) is first
        assert times == []

    def test_feature_another_process_reads_it(self, times):
        first = profile_for("gather", LARGE, ABLE, ALL)
        times.clear()
        cost_store.forget_in_process()
        assert profile_for("gather", LARGE, ABLE, ALL) == first
        assert times == []

    @pytest.mark.parametrize(
        ("kind", "pixels", "able"),
        [("gather", SMALL, ABLE), ("scatter", LARGE, ABLE), ("gather", LARGE, ABLE[1:]), ("gather", LARGE, ABLE[:1])],
    )
    def test_feature_other_scenes_are_priced_alike_before_and_after(self, times, kind, pixels, able):
        before = profile_for(kind, pixels, able, ALL)
        assert times == []
        profile_for("gather", LARGE, ABLE, ALL)
        assert profile_for(kind, pixels, able, ALL) is before

    def test_feature_not_where_it_is_turned_off(self, times, monkeypatch):
        monkeypatch.setenv(cost_store.TUNE, "off")
        assert profile_for("gather", LARGE, ABLE, ALL) == shipped_profile()
        assert times == []

    def test_feature_not_in_a_worker_that_loads_data(self, times, monkeypatch):
        monkeypatch.setattr(first_use, "get_worker_info", object)
        assert profile_for("gather", LARGE, ABLE, ALL) == shipped_profile()
        assert times == []

    def test_feature_not_where_tune_has_measured(self, times):
        write_profile(THREADS, StoredProfile(EPYC, ("gather", "occlusion")))
        assert profile_for("gather", LARGE, ABLE, ALL) == EPYC
        assert times == []

    def test_feature_a_busy_machine_is_not_believed_and_not_kept(self, times, monkeypatch):
        took = iter(range(1, 10_000))
        monkeypatch.setattr(first_use, "time_rendering", lambda *_: 2.0 ** next(took))
        assert profile_for("gather", LARGE, ABLE, ALL) == shipped_profile()
        assert read_profile(THREADS) is None
        monkeypatch.setattr(first_use, "time_rendering", lambda *_: pytest.fail("measured again"))
        assert profile_for("gather", LARGE, ABLE, ALL) == shipped_profile()

    def test_feature_threads_wait_for_one_measurement(self, times):
        found = []
        workers = [
            threading.Thread(target=lambda: found.append(profile_for("gather", LARGE, ABLE, ALL))) for _ in range(4)
        ]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        assert len({id(profile) for profile in found}) == 1

    def test_feature_the_choice_follows(self, times, monkeypatch):
        """Direct is the fastest for small PSFs, unless it takes six times as long as the shipped constants say."""
        monkeypatch.setenv(cost_store.TUNE, "off")
        assert choose(sample_scene(200, 5)).name == "direct"
        monkeypatch.delenv(cost_store.TUNE)
        monkeypatch.setattr(dispatch, "_choices", {})
        cost_store.forget_in_process()
        assert choose(sample_scene(200, 5)).name == "overlap"
        assert choose(sample_scene(100, 5)).name == "direct"


@needs_compiler
class TestMeasureFactors(BaseTester):
    @pytest.mark.parametrize("kind", ["gather", "occlusion"])
    def test_smoke_a_factor_for_each_backend_or_none_where_the_machine_is_busy(self, kind):
        factors = measure_factors(kind, ALL, EPYC)
        if factors is not None:
            assert set(factors) == set(cost_store.KINDS[kind])
            assert all(factor > 0 for factor in factors.values())

    def test_feature_gives_up_after_a_second(self, monkeypatch):
        clock = iter(range(1000))
        monkeypatch.setattr(first_use.time, "perf_counter", lambda: next(clock))
        timed = []
        monkeypatch.setattr(first_use, "time_rendering", lambda backend, _: timed.append(backend) or 1.0)
        assert measure_factors("gather", ALL, EPYC) is None
        assert len(timed) == 2 * 2 * len(ALL)  # two rounds over two scenes, a second each
