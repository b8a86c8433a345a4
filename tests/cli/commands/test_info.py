"""`kornia-tidy info`."""

from __future__ import annotations

import os
import shutil

import pytest
import torch

from kornia_tidy import cli
from kornia_tidy.kernels import build as compiled
from kornia_tidy.kernels import gather_ops, report
from tests.base import BaseTester
from tests.kernels.test_build import forget


class TestInfo(BaseTester):
    @pytest.fixture(autouse=True)
    def _anew(self, tmp_path, monkeypatch):
        monkeypatch.setattr(compiled.tempfile, "tempdir", str(tmp_path))
        forget()
        yield
        forget()

    @staticmethod
    def told(capsys) -> dict[str, list[str]]:
        assert cli.main(["info"]) == 0
        captured = capsys.readouterr()
        assert captured.err == ""
        topics: dict[str, list[str]] = {}
        for line in captured.out.splitlines():
            topic, text = line.split(maxsplit=1)
            topics.setdefault(topic, []).append(text)
        return topics

    def test_smoke(self, capsys):
        topics = self.told(capsys)
        assert f"torch {torch.__version__.split('+', maxsplit=1)[0]}" in topics["uses"][0]
        assert f"{os.cpu_count()} CPUs" in topics["processor"][0]
        assert len(topics["kernel"]) == 2 * len(report.SOURCES)

    @pytest.mark.skipif(compiled.build(gather_ops.SOURCE, torch.float32).library is None, reason="no C compiler")
    def test_feature_kernels_and_their_cache(self, capsys):
        topics = self.told(capsys)
        assert topics["kernel"][0].startswith("direct.c, float32: compiled for this processor by ")
        assert all(text.endswith(".so") for text in topics["kernel"])

    @pytest.mark.skipif(compiled.build(gather_ops.SOURCE, torch.float32).library is None, reason="no C compiler")
    @pytest.mark.takes_seconds
    def test_feature_libraries_that_were_removed_meanwhile(self, capsys, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        monkeypatch.setattr(report, "SOURCES", report.SOURCES[-1:])
        assert self.told(capsys)["cache"][0].startswith(f"{tmp_path}/cache/kornia_tidy, 2 files, ")
        shutil.rmtree(tmp_path / "cache")
        topics = self.told(capsys)
        assert len(topics["kernel"]) == 2
        assert topics["cache"] == [f"{tmp_path}/cache/kornia_tidy, 0 files, 0 KiB"]

    def test_feature_without_a_compiler_it_says_why(self, capsys, monkeypatch):
        monkeypatch.setenv("CC", "false")
        topics = self.told(capsys)
        why = "the C compiler false failed (status 1): no word"
        assert topics["compiler"] == [why]
        assert all(f"not there: {why}; the wheel that" in text for text in topics["kernel"])

    def test_feature_the_home_folder_is_not_named(self, capsys, tmp_path, monkeypatch):
        monkeypatch.setenv("HOME", str(tmp_path))
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr(report, "SOURCES", ())
        assert self.told(capsys)["cache"][0].startswith("~/.cache/kornia_tidy, ")
