from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from kornia_tidy.moved import MOVED, new_name


class TestMoved:
    @pytest.mark.parametrize("old", MOVED)
    def test_feature_an_old_name_is_the_module_itself_and_warns(self, old):
        new = f"kornia_tidy.{MOVED[old]}"
        sys.modules.pop(f"kornia_tidy.{old}", None)
        with pytest.warns(FutureWarning, match=f"kornia_tidy.{old} is now {new}$"):
            found = importlib.import_module(f"kornia_tidy.{old}")
        assert found is importlib.import_module(new)
        assert found.__spec__.name == new

    @pytest.mark.takes_seconds
    def test_feature_a_module_inside_is_imported_once(self):
        """Whether the old name comes first or the new one."""
        orders = ("systems.units", "optics.units"), ("lab.raw.color", "raw.color")
        pairs = [tuple(f"kornia_tidy.{name}" for name in names) for names in orders]
        code = f"from importlib import import_module as of; print(*(of(x) is of(y) for x, y in {pairs}))"
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert said.stdout == "True True\n"
        assert said.stderr.count("FutureWarning") == 2

    @pytest.mark.filterwarnings("ignore::FutureWarning")
    @pytest.mark.parametrize("name", ["kornia_tidy.nothing", "kornia_tidy.raw.nothing", "kornia_tidy.masks.nothing"])
    def test_exception_no_such_module(self, name):
        with pytest.raises(ModuleNotFoundError, match="nothing"):
            importlib.import_module(name)

    def test_feature_names_that_stayed_have_no_new_one(self):
        assert new_name("kornia_tidy.masks") is new_name("raw") is new_name("kornia_tidy") is None
