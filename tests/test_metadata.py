"""What an index of packages shows of this one."""

from __future__ import annotations

import re
import runpy
import sys
import tomllib
from pathlib import Path

import pytest

import kornia_tidy
from tests.base import BaseTester

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


class TestMetadata(BaseTester):
    def test_smoke_authors_and_addresses(self):
        assert [author["name"] for author in PROJECT["authors"]] == ["The kornia_tidy authors"]
        assert set(PROJECT["urls"]) == {"Paper"}  # the repository has no public address that was confirmed
        assert all(address.startswith("https://") for address in PROJECT["urls"].values())

    def test_smoke_the_citation_is_of_this_version(self):
        lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
        assert f"version: {kornia_tidy.__version__}" in lines

    def test_smoke_the_changelog_has_a_section_for_this_version(self):
        """``release.yml`` publishes it."""
        lines = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()
        assert lines.count(f"## {kornia_tidy.__version__}") == 1

    @pytest.mark.parametrize("path", sorted((ROOT / ".github" / "workflows").glob("*.yml")), ids=lambda path: path.stem)
    def test_smoke_workflows_make_targets_that_exist(self, path):
        targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
        assert set(re.findall(r"run: make ([\w-]+)", path.read_text(encoding="utf-8"))) <= targets

    def test_smoke_the_package_runs_as_the_command(self, monkeypatch, capsys):
        monkeypatch.setattr(sys, "argv", ["kornia_tidy", "--version"])
        with pytest.raises(SystemExit) as exit_:
            runpy.run_module("kornia_tidy", run_name="__main__")
        assert exit_.value.code == 0
        assert capsys.readouterr().out.startswith("kornia-tidy ")
