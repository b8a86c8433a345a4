from __future__ import annotations

import json
import os
from dataclasses import replace

import pytest
import torch

from kornia_tidy.render import cost_store, dispatch
from kornia_tidy.render.cost_profile import EPYC, XEON
from kornia_tidy.render.cost_store import (
    KINDS,
    StoredProfile,
    forget_in_process,
    forget_profile,
    measured_profile,
    profile_path,
    read_profile,
    settle_measured,
    settled,
    settled_profile,
    shipped_profile,
    write_profile,
)
from kornia_tidy.render.dispatch import choose
from kornia_tidy.render.repeatable import repeatable
from kornia_tidy.render.scene_samples import sample_scene
from tests.base import BaseTester

OTHER = EPYC.scaled("another machine", {"direct": 3.0})
THREADS = torch.get_num_threads()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, as on a new machine, in a process that has not asked yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(cost_store.TUNE)
    monkeypatch.setattr(dispatch, "_choices", {})
    forget_in_process()
    yield tmp_path / "kornia_tidy"
    forget_in_process()


class TestFile(BaseTester):
    def test_feature_what_is_kept_is_read(self, cache):
        assert read_profile(3) is None
        path = write_profile(3, StoredProfile(OTHER, ("gather",)))
        assert path.parent == cache
        assert read_profile(3) == StoredProfile(OTHER, ("gather",))
        assert read_profile(4) is None
        assert forget_profile(3) == path
        assert read_profile(3) is None
        assert forget_profile(3) is None

    def test_feature_nothing_is_left_beside_it_and_only_the_user_may_read_it(self, cache):
        path = write_profile(3, StoredProfile(OTHER))
        assert list(cache.iterdir()) == [path]
        assert path.stat().st_mode & 0o777 == 0o600

    @pytest.mark.parametrize("part", ["torch", "compiler", "processor"])
    def test_feature_another_machine_does_not_read_it(self, cache, monkeypatch, part):
        write_profile(3, StoredProfile(OTHER))
        if part == "torch":
            monkeypatch.setattr(cost_store.torch, "__version__", "9.9")
        elif part == "compiler":
            monkeypatch.setattr(cost_store, "maker", lambda: "cc 99")
        else:
            monkeypatch.setattr(cost_store, "processor_features", lambda: b"GenuineIntel 9")
        assert read_profile(3) is None

    @pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners here")
    def test_feature_a_file_that_others_may_write_to_is_not_trusted(self, cache):
        path = write_profile(3, StoredProfile(OTHER))
        path.chmod(0o666)
        assert read_profile(3) is None

    def test_feature_a_link_is_not_followed(self, cache, tmp_path):
        path = write_profile(3, StoredProfile(OTHER))
        path.rename(tmp_path / "elsewhere.json")
        path.symlink_to(tmp_path / "elsewhere.json")
        assert read_profile(3) is None

    @pytest.mark.parametrize(
        "text",
        ["", "{", "[]", "null", '{"profile": {}, "measured": []}', "[" * 10_000, '{"measured": []}', "NaN", "\0"],
    )
    def test_feature_a_damaged_file_is_passed_over(self, cache, text):
        write_profile(3, StoredProfile(OTHER)).write_text(text)
        assert read_profile(3) is None

    def test_feature_a_price_that_is_no_time_is_passed_over(self, cache):
        path = write_profile(3, StoredProfile(OTHER))
        document = json.loads(path.read_text())
        document["profile"]["tiled"]["pair"] = -1
        path.write_text(json.dumps(document))
        assert read_profile(3) is None

    def test_feature_a_long_file_is_not_read(self, cache, monkeypatch):
        write_profile(3, StoredProfile(OTHER))
        monkeypatch.setattr(cost_store, "LARGEST_FILE", 100)
        assert read_profile(3) is None

    def test_feature_off_in_the_environment_reads_nothing(self, cache, monkeypatch):
        write_profile(3, StoredProfile(OTHER))
        monkeypatch.setenv(cost_store.TUNE, "off")
        assert read_profile(3) is None


class TestInUse(BaseTester):
    def test_feature_shipped_unless_one_is_kept(self, cache):
        assert settled() == StoredProfile(shipped_profile())
        forget_in_process()
        write_profile(THREADS, StoredProfile(OTHER, tuple(KINDS)))
        assert settled_profile() == OTHER

    @pytest.mark.parametrize(("vendor", "profile"), [(b"GenuineIntel", XEON), (b"AuthenticAMD", EPYC), (b"", EPYC)])
    def test_feature_the_nearest_processor_is_shipped(self, monkeypatch, vendor, profile):
        monkeypatch.setattr(cost_store, "processor_features", lambda: b"model name\t: " + vendor)
        assert shipped_profile() is profile

    def test_feature_a_profile_is_fixed_once_it_was_asked_for(self, cache):
        before = settled()
        write_profile(THREADS, StoredProfile(OTHER, tuple(KINDS)))
        assert settled() is before

    @pytest.mark.takes_seconds
    def test_feature_repeatable_rendering_knows_the_shipped_profile_only(self, cache):
        """And its choices are remembered apart."""
        scene = sample_scene(96, 15)
        with repeatable():
            usual = choose(scene).name
        slow = shipped_profile().scaled("slow", {usual: 1e6})
        for threads in {1, THREADS}:
            write_profile(threads, StoredProfile(slow, tuple(KINDS)))
        forget_in_process()
        other = choose(scene).name
        assert other != usual
        with repeatable():
            assert (settled_profile(), choose(scene).name) == (shipped_profile(), usual)
        assert (settled_profile(), choose(scene).name) == (slow, other)

    def test_feature_what_is_measured_is_kept_beside_what_was(self, cache):
        slow = shipped_profile().scaled("slow", {"direct": 2.0})
        settle_measured("gather", slow)
        assert measured_profile("gather") is slow
        assert measured_profile("occlusion") is None
        other = shipped_profile().scaled("slow", {"occlusion_tiled": 3.0})
        settle_measured("occlusion", other)
        kept = read_profile(THREADS)
        assert set(kept.measured) == {"gather", "occlusion"}
        assert kept.profile == replace(slow, occlusion_tiled=other.occlusion_tiled)

    def test_feature_a_cache_that_cannot_be_written_to_serves_the_process(self, cache, monkeypatch):
        def refuse(*_):
            raise PermissionError("read-only")

        monkeypatch.setattr(cost_store, "write_profile", refuse)
        settle_measured("gather", OTHER)
        assert measured_profile("gather") is OTHER
        assert not profile_path(THREADS).exists()
