"""Sanitizers on the package's C sources: they detect planted faults and report none in the original sources."""

from __future__ import annotations

import shutil

import pytest

from tests.base import BaseTester
from tests.kernels.kernel_shapes import KERNELS
from tests.kernels.sanitize import ROOT, main, sanitized, why_not

ROW = "const REAL *x = kernel + (p * order + q) * cells * 2;"
FAULTS = {  # faults planted in mutual_intensity.c, with their reports
    "read beyond the end": (ROW, ROW.replace("+ q)", "+ q + 1)"), "heap-buffer-overflow"),
    "overflow": ("int64_t s = 0;", "int64_t s = 0; volatile int n = 2147483647; n = n + 1;", "signed integer overflow"),
}


@pytest.mark.slow
@pytest.mark.skipif(why_not() is not None, reason=str(why_not()))
class TestSanitize(BaseTester):
    @pytest.mark.parametrize("kind", FAULTS)
    def test_feature_a_planted_fault_is_found(self, kind, tmp_path):
        shutil.copytree(ROOT / "kornia_tidy", tmp_path / "kornia_tidy", ignore=shutil.ignore_patterns("__pycache__"))
        source = tmp_path / "kornia_tidy/kernels/mutual_intensity.c"
        text, (there, planted, found) = source.read_text(), FAULTS[kind]
        assert text.count(there) == 1
        source.write_text(text.replace(there, planted))
        ended = sanitized(20, 0, "mutual_intensity.c", root=tmp_path, capture=True)
        assert ended.returncode != 0
        assert found in ended.stderr
        assert "mutual_intensity.c:" in ended.stderr

    def test_smoke_nothing_is_found_in_the_sources_as_they_are(self, capfd):
        assert main(["--shapes", "5"]) == 0
        assert capfd.readouterr().out.count("5 random shapes") == len(KERNELS)


class TestWithoutSanitizers(BaseTester):
    def test_feature_it_is_said(self, monkeypatch, capsys):
        monkeypatch.setattr("tests.kernels.sanitize.shutil.which", lambda program: None)
        assert main([]) == 0
        assert capsys.readouterr().out == "not run: sanitizers need Linux and gcc\n"
