"""Smoke tests of the benchmarks, which the test suite does not time: each runs once, and its output is checked."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.base import BaseTester
from tests.benchmarks.table import markdown, read_benchmarks

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
SUITES = {path.stem.removeprefix("test_") for path in (ROOT / "tests" / "benchmarks").glob("test_*.py")}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The file that one short run of all benchmarks writes."""
    path = tmp_path_factory.mktemp("benchmarks") / "benchmarks.json"
    once = ["--benchmark-min-rounds=1", "--benchmark-max-time=0", "--benchmark-calibration-precision=1"]
    once += ["--benchmark-min-time=1e-9", "--benchmark-warmup=off", "--benchmark-quiet"]
    command = [sys.executable, "-m", "pytest", "--override-ini", "addopts=", "-q", "tests/benchmarks"]
    outside = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}  # no worker's
    done = subprocess.run(
        [*command, *once, f"--benchmark-json={path}", "-p", "no:cacheprovider"],
        cwd=ROOT,
        env={**outside, "KORNIA_TIDY_BENCH_SIZE": "40", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return path


class TestBenchmarks(BaseTester):
    def test_smoke_every_suite_runs_and_keeps_to_the_schema(self, written):
        document = read_benchmarks(written)
        assert {entry["group"] for entry in document["benchmarks"]} == SUITES

    def test_feature_the_table_has_a_line_for_each(self, written):
        document = read_benchmarks(written)
        lines = markdown(document).splitlines()[2:]
        assert len(lines) == 2 + len(document["benchmarks"])
        assert len({line.count("|") for line in lines}) == 1
        assert any("psf_bank: by masks[cpu-16]" in line and "| 16 | 21 | 23² | 3 | 23² |" in line for line in lines)

    @pytest.mark.parametrize(
        ("damage", "sentence"),
        [
            (lambda d: d.pop("datetime"), "the file has no datetime"),
            (lambda d: d["benchmarks"].clear(), "the file has no benchmarks"),
            (lambda d: d["benchmarks"][0]["extra_info"].pop("pupil"), "extra_info of .* has no pupil"),
            (lambda d: d["benchmarks"][0]["extra_info"].update(masks="5"), "masks of .* must be int, got '5'"),
            (lambda d: d["benchmarks"][0]["stats"].update(median=None), "median of .* must be float, got None"),
            (lambda d: d["benchmarks"][0]["stats"].update(median=-1.0), "are out of order"),
        ],
    )
    def test_exception_names_what_is_missing(self, damage, sentence, written, tmp_path):
        document = copy.deepcopy(read_benchmarks(written))
        damage(document)
        (tmp_path / "damaged.json").write_text(json.dumps(document))
        with pytest.raises(ValueError, match=sentence):
            read_benchmarks(tmp_path / "damaged.json")
