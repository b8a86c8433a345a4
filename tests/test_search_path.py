"""Later imports, worker processes and programs after a change into a folder with files of the same names."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec

import pytest

from kornia_tidy.data.exr import decode_exr
from kornia_tidy.data.hdf5 import decode_hdf5
from kornia_tidy.figures import require_matplotlib
from kornia_tidy.reconstruction.baselines import load_zoedepth
from kornia_tidy.reconstruction.hub import from_pretrained
from kornia_tidy.search_path import find_program, import_extra, import_installed
from kornia_tidy.training.lightning_extra import require_lightning
from tests.base import BaseTester


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, in which everything notes that it was executed."""
    here = tmp_path / "downloads"
    here.mkdir()
    for name in ("multiprocessing", "pickle", "torch", "h5py", "rawpy", "planted"):
        (here / f"{name}.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'a').write('{name}')\n")
    (here / "git").write_text(f"#!/bin/sh\necho git >> {tmp_path / 'mark'}\necho planted\n")
    (here / "git").chmod(0o755)
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "path", ["", ".", *sys.path])
    return here


def executed(folder):
    mark = folder.parent / "mark"
    return mark.read_text() if mark.exists() else ""


class TestSearchPath(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.skipif(find_spec("h5py") is None, reason="h5py is not installed")
    def test_feature_a_reader_imports_its_package_from_where_it_is_installed(self, folder):
        script = (
            "import os\nfrom kornia_tidy.data.hdf5 import decode_hdf5\n"
            f"os.chdir({str(folder)!r})\n"
            "try: decode_hdf5(b'\\x89HDF\\r\\n\\x1a\\n')\nexcept ValueError as error: print(error)"
        )
        options = {"cwd": folder.parent, "capture_output": True, "text": True}
        done = subprocess.run([sys.executable, "-c", script], check=False, **options)
        assert "HDF5 is damaged" in done.stdout, done.stderr
        assert executed(folder) == ""

    def test_exception_what_is_not_installed_is_not_found_in_the_current_folder(self, folder):
        with pytest.raises(ImportError, match="planted"):
            import_installed("planted")
        assert sys.path[:2] == ["", "."]
        assert executed(folder) == ""

    @pytest.mark.parametrize("path", [".", "", f".{os.pathsep}{{}}", f"{os.pathsep}{{}}"])
    def test_feature_programs_come_from_the_folders_that_path_names(self, path, folder, monkeypatch):
        monkeypatch.setenv("PATH", path.format(os.environ["PATH"]))
        with suppress(FileNotFoundError):  # where git is in none of them
            subprocess.run([find_program("git"), "--version"], check=True, cwd=folder)
        assert executed(folder) == ""

    def test_exception_a_program_that_is_missing(self, folder, monkeypatch):
        monkeypatch.setenv("PATH", "downloads")
        with pytest.raises(FileNotFoundError, match="no program git in the folders of PATH"):
            find_program("git")


ADAPTERS = ("torchvision_v2", "albumentations_v2", "deepinv_physics")


def importing(name):
    return lambda: import_module(f"kornia_tidy.{name}")


class TestExtras(BaseTester):
    @pytest.mark.parametrize(
        ("module", "use", "line"),
        [
            ("matplotlib.figure", require_matplotlib, "'kornia-tidy[plot]'"),
            ("lightning.pytorch", require_lightning, "'kornia-tidy[train]'"),
            ("tensorboard", require_lightning, "'kornia-tidy[train]'"),
            ("transformers", lambda: load_zoedepth("a"), "'kornia-tidy[baselines]'"),
            ("huggingface_hub", lambda: from_pretrained("nobody/nothing"), "'kornia-tidy[hub]'"),
            ("h5py", lambda: decode_hdf5(b""), "'kornia-tidy[data]'"),
            ("OpenEXR", lambda: decode_exr(b""), "'kornia-tidy[exr]'"),
            ("gradio", importing("cli.app.page"), "'kornia-tidy[app]'"),
            ("torchvision", importing("augmentation.torchvision_v2"), "torchvision"),
            ("albumentations", importing("augmentation.albumentations_v2"), "albumentations"),
            ("deepinv.physics", importing("augmentation.deepinv_physics"), "deepinv"),
        ],
    )
    def test_exception_each_package_that_is_missing_gets_the_line_to_type(self, module, use, line, monkeypatch):
        for name in ("cli.app.page", *(f"augmentation.{name}" for name in ADAPTERS)):
            monkeypatch.delitem(sys.modules, f"kornia_tidy.{name}", raising=False)
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError) as caught:
            use()
        package = module.partition(".")[0]
        assert f" needs {package}: pip install {line}" in str(caught.value)

    def test_exception_a_fault_of_an_installed_package_is_told(self, tmp_path, monkeypatch):
        (tmp_path / "faulty.py").write_text("raise RuntimeError('operator nms does not exist')")
        monkeypatch.syspath_prepend(tmp_path)
        with pytest.raises(ImportError, match=r"needs faulty: pip install faulty \(operator nms does not exist\)"):
            import_extra("faulty", "a test")
