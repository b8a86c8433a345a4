from __future__ import annotations

import math
from dataclasses import replace

import pytest

from kornia_tidy import cli
from kornia_tidy.commands import tune
from kornia_tidy.render import cost_store, tuning
from kornia_tidy.render.cost_model import seconds_of
from kornia_tidy.render.cost_store import KINDS, StoredProfile, read_profile, shipped_profile, write_profile
from kornia_tidy.render.tuning import Case, measure
from tests.base import BaseTester
from tests.render.test_cost_store import THREADS, cache  # noqa: F401

FEW = [Case(kind, 64, psf_size, 2, "linear") for kind in KINDS for psf_size in (5, 9)]


@pytest.mark.usefixtures("cache")
class TestTune(BaseTester):
    @pytest.fixture(autouse=True)
    def _small(self, monkeypatch):
        """Few scenes, and a machine on which everything takes twice as long as shipped constants say."""

        def twice(cases, seconds, progress):
            progress(1.0)
            return [
                replace(one, seconds=2 * seconds_of(one.work, shipped_profile(), one.threads))
                for one in measure(cases, 60, threads=(THREADS,))
                if math.isfinite(one.seconds)
            ]

        monkeypatch.setattr(tuning, "ROUNDS", 1)
        monkeypatch.setattr(tune, "tuning_cases", lambda: FEW)
        monkeypatch.setattr(tune, "measure", twice)

    def test_feature_measures_tells_and_keeps(self, capsys):
        assert cli.main(["tune"]) == 0
        out = capsys.readouterr().out
        assert "tiled" in out
        assert "2.00 (2.00 to 2.00) as shipped, 1.00 (1.00 to 1.00) tuned" in out
        assert "100% of 4 cases within 1.15 of the fastest backend" in out
        kept = read_profile(THREADS)
        assert kept.profile.name == f"tuned here, {THREADS} threads"
        assert set(kept.measured) == set(KINDS)

    def test_feature_a_profile_that_chooses_worse_is_not_kept(self, capsys, monkeypatch):
        worse = shipped_profile().scaled("worse", {"tiled": 1e9, "occlusion_tiled": 1e9, "direct": 1e9})
        monkeypatch.setattr(tune, "fit_profile", lambda *_: worse)
        monkeypatch.setattr(tune, "regrets", lambda profile, _: [2.0 if profile is worse else 1.0])
        assert cli.main(["tune"]) == 2
        assert "is not kept: is the machine idle?" in capsys.readouterr().err
        assert read_profile(THREADS) is None

    def test_feature_shows_what_is_in_use(self, capsys):
        assert cli.main(["tune", "--show"]) == 0
        assert f"{shipped_profile().name} as shipped, for {THREADS} threads" in capsys.readouterr().out
        write_profile(THREADS, StoredProfile(replace(shipped_profile(), name="tuned"), ("gather",)))
        assert cli.main(["tune", "--show"]) == 0
        out = capsys.readouterr().out
        assert f"tuned, measured for gather on {THREADS} threads" in out
        assert "tiled: shared" in out

    def test_feature_forgets(self, capsys):
        write_profile(THREADS, StoredProfile(shipped_profile()))
        assert cli.main(["tune", "--forget"]) == 0
        assert read_profile(THREADS) is None
        assert cli.main(["tune", "--forget"]) == 0
        assert f"nothing: no profile is kept for {THREADS} threads" in capsys.readouterr().out

    def test_exception_show_and_forget_at_once(self):
        with pytest.raises(SystemExit):
            cli.main(["tune", "--show", "--forget"])

    def test_exception_a_cache_that_cannot_be_used_is_told_of_before_measuring(self, capsys, monkeypatch):
        def refuse():
            raise PermissionError("must belong to the user")

        monkeypatch.setattr(cost_store, "cache_folder", refuse)
        monkeypatch.setattr(tune, "measure", lambda *_, **__: pytest.fail("measured"))
        assert cli.main(["tune"]) == 2
        assert "must belong to the user" in capsys.readouterr().err

    def test_feature_info_names_the_profile(self, capsys):
        write_profile(THREADS, StoredProfile(replace(shipped_profile(), name="mine"), tuple(KINDS)))
        assert cli.main(["info"]) == 0
        assert f"mine, measured for gather and occlusion on {THREADS} threads" in capsys.readouterr().out
