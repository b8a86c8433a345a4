"""A raw file among other people's files: its decoder imports NumPy and LibRaw from where they are installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from kornia_tidy.lab.raw.decoding import decode_raw
from tests.base import BaseTester
from tests.lab.raw.dng import dng

DATA = dng(np.random.default_rng(0).integers(64, 1000, (36, 48)))
PLANTED = """
import os, sys
with open({mark!r}, "a") as file:
    file.write(os.path.basename(sys.argv[0]) + ":{name}\\n")
before, sys.path = sys.path, [entry for entry in sys.path if os.path.abspath(entry or ".") != {folder!r}]
del sys.modules["{name}"]
try:
    import {name}  # so that a caller whose path begins with this folder goes on
finally:
    sys.path = before
"""
IMPORT = "import os; from kornia_tidy.lab.raw.decoding import decode_raw\n"
OPEN = "print('opened', tuple(decode_raw({photo!r}, 60, 2**31)[1].shape))\n"


@pytest.fixture
def downloads(tmp_path):
    """A folder with a raw file, and modules with names that its decoder asks for; each notes who imports it."""
    folder = tmp_path / "downloads"
    (folder / "numpy").mkdir(parents=True)
    (folder / "photo.dng").write_bytes(DATA)
    for name in ("numpy", "rawpy", "json", "resource", "secrets", "tags"):
        place = folder / "numpy" / "__init__.py" if name == "numpy" else folder / f"{name}.py"
        place.write_text(PLANTED.format(mark=str(tmp_path / "mark"), folder=str(folder), name=name))
    return folder


def executed(folder):
    """What was executed of a folder, as program:module."""
    mark = folder.parent / "mark"
    return mark.read_text().split() if mark.exists() else []


def callers(folder):
    """Arguments, working folder, PYTHONPATH and standard input of every kind of caller.

    The path of those in the second group begins with the folder by Python's own rules: they import from it themselves.
    """
    python, elsewhere = sys.executable, folder.parent
    console, info = shutil.which("kornia-tidy", path=os.path.dirname(python)), ["raw", "info", "photo.dng"]
    there = IMPORT + OPEN.format(photo="photo.dng")
    later = f"{IMPORT}os.chdir({str(folder)!r})\n" + OPEN.format(photo="photo.dng")
    left = f"import os; os.chdir({str(elsewhere)!r})\n" + IMPORT + OPEN.format(photo=str(folder / "photo.dng"))
    kernel = f"import sys; sys.path.insert(0, '')\nfor cell in {later.splitlines()!r}: exec(cell)\n"
    scripts = {"there": elsewhere / "there.py", "later": elsewhere / "later.py", "beside": folder / "beside.py"}
    beside = IMPORT + OPEN.format(photo=str(folder / "photo.dng"))
    for path, text in zip(scripts.values(), (there, later, beside), strict=True):
        path.write_text(text)
    clean = {
        "console": ([console, *info], folder, None, None),
        "script": ([python, scripts["there"]], folder, None, None),
        "script, later": ([python, scripts["later"]], elsewhere, None, None),
        "-c, later": ([python, "-c", later], elsewhere, None, None),
        "-c, isolated": ([python, "-I", "-c", there], folder, None, None),
        "standard input, later": ([python, "-"], elsewhere, None, later),
        "notebook, later": ([python, "-c", kernel], elsewhere, None, None),
        "PYTHONPATH with ., later": ([python, scripts["later"]], elsewhere, ".", None),
    }
    own = {
        "console, PYTHONPATH with .": ([console, *info], folder, ".", None),
        "console, PYTHONPATH with an empty entry": ([console, *info], folder, f"{os.pathsep}/none", None),
        "-m": ([python, "-m", "kornia_tidy", *info], folder, None, None),
        "script beside the file": ([python, scripts["beside"]], elsewhere, None, None),
        "-c": ([python, "-c", there], folder, None, None),
        "-c, left before": ([python, "-c", left], folder, None, None),
        "-c, left before, PYTHONPATH with .": ([python, "-c", left], folder, ".", None),
        "standard input": ([python, "-"], folder, None, there),
        "PYTHONPATH with an empty entry": ([python, scripts["there"]], folder, f"{os.pathsep}/none", None),
    }
    return clean, own


class TestDecoderProcess(BaseTester):
    @pytest.mark.parametrize("entries", [["", "."], ["", "downloads"], ["{folder}"], ["{folder}", "", "{folder}"]])
    def test_feature_nothing_beside_a_raw_file_is_executed(self, entries, downloads, monkeypatch):
        """Whether the path leads there by its empty or relative entries, or as a folder that -m or PYTHONPATH names."""
        monkeypatch.chdir(downloads)
        monkeypatch.setattr(sys, "path", [entry.format(folder=downloads) for entry in entries] + sys.path)
        assert decode_raw("photo.dng", 60, 2**31)[1].shape == (1, 36, 48)
        assert executed(downloads) == []

    def test_feature_packages_that_only_the_current_folder_has_are_found(self, tmp_path, monkeypatch):
        """As `pip install --target .` and then `python -c` have it: NumPy's own folder then has LibRaw as well."""
        here = os.path.dirname(os.path.dirname(np.__file__))
        monkeypatch.chdir(here)
        other = [entry for entry in sys.path if not os.path.exists(os.path.join(entry or ".", "numpy"))]
        monkeypatch.setattr(sys, "path", ["", *other])
        assert decode_raw(DATA, 60, 2**31)[1].shape == (1, 36, 48)

    @pytest.mark.slow
    def test_feature_nothing_is_executed_from_the_folder_whoever_the_caller_is(self, downloads):
        clean, own = callers(downloads)
        found = {}
        for name, (command, folder, path, text) in {**clean, **own}.items():
            environment = {**os.environ, "OMP_NUM_THREADS": "1"} | ({} if path is None else {"PYTHONPATH": path})
            done = subprocess.run(
                command, cwd=folder, env=environment, input=text, capture_output=True, text=True, check=False
            )
            ran = executed(downloads)
            (downloads.parent / "mark").unlink(missing_ok=True)
            wrong = ran if name in clean else [line for line in ran if line.startswith("decoder.py:")]
            if done.returncode or wrong or not ("opened (1, 36, 48)" in done.stdout or "48 x 36" in done.stdout):
                found[name] = done.returncode, wrong, done.stdout[-200:], done.stderr[-500:]
        assert not found, json.dumps(found, indent=1)
