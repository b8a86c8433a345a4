"""What importing the library costs, and what it leaves alone: in interpreters that did nothing else."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.base import BaseTester

HEAVY = ("colour", "matplotlib", "rawpy", "h5py", "lightning", "scipy", "sympy", "torch._dynamo")
LISTED = f"""
import sys
import cv2, kornia, torch
before = set(sys.modules)
import kornia_tidy
print(*sorted({{name.partition(".")[0] for name in set(sys.modules) - before}} - set(sys.stdlib_module_names)))
kornia_tidy.TiDyOptics
print(*(name for name in {HEAVY} if name in sys.modules and name not in before))
print(*sorted({{name.partition(".")[0] for name in set(sys.modules) - before}} - set(sys.stdlib_module_names)))
import kornia_tidy.augmentation
added = set(sys.modules) - before
print(len(added))
print(*(name for name in {HEAVY} if name in added))
import importlib, pkgutil, warnings
from types import ModuleType
warnings.simplefilter("ignore")  # of packages that others need
for info in pkgutil.iter_modules(kornia_tidy.__path__, "kornia_tidy."):
    package = importlib.import_module(info.name) if info.ispkg else None
    for name in getattr(package, "__all__", ()):
        if importlib.util.find_spec(f"{{info.name}}.{{name}}"):
            importlib.import_module(f"{{info.name}}.{{name}}")
            print(info.name, name, isinstance(getattr(package, name), ModuleType))
"""
WORDS = """
import contextlib, io, sys
from kornia_tidy.cli import main
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main(sys.argv[1:])
print(len(sys.modules))
print(*(name for name in ("torch", "numpy", "kornia", "cv2") if name in sys.modules))
"""


def python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def imported():
    return python("-W", "error", "-c", LISTED)


class TestImport(BaseTester):
    def test_feature_import_is_silent_with_warnings_as_errors(self, imported):
        assert (imported.returncode, imported.stderr) == (0, "")

    def test_feature_heavy_packages_are_left_until_they_are_needed(self, imported):
        assert imported.stdout.splitlines()[1] == ""

    def test_feature_no_other_package_is_added_to_those_of_every_pipeline(self, imported):
        assert imported.stdout.splitlines()[0] == "kornia_tidy"
        assert imported.stdout.splitlines()[2] == "kornia_tidy safetensors"

    def test_feature_augmentations_add_their_own_modules_to_those_of_kornia(self, imported):
        """154 modules on 2026-11-28, a fifth of a second; ``torch._dynamo`` by itself brought 820 of them."""
        count, heavy = imported.stdout.splitlines()[3:5]
        assert int(count) < 250
        assert heavy == ""

    @pytest.mark.parametrize("words", ["--help", "--version", "train --help", "train --task depht", "raw --help"])
    def test_feature_help_comes_without_torch(self, words):
        """At most 196 modules on 2026-11-28, a tenth of a second; torch by itself brings 1500."""
        done = python("-c", WORDS, *words.split())
        count, heavy = done.stdout.splitlines()
        assert int(count) < 260
        assert heavy == ""
        assert len(done.stderr.splitlines()) <= 3

    def test_feature_a_name_means_the_function_after_its_module_was_imported(self, imported):
        """Of each public name that its module shares."""
        lines = imported.stdout.splitlines()[5:]
        assert len(lines) >= 5
        assert [line for line in lines if line.endswith("True")] == []
