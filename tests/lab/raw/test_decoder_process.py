"""A raw file among other people's files: its decoder imports NumPy and LibRaw from where they are installed."""

from __future__ import annotations

import os
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
