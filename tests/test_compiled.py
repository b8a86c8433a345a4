"""C sources that are compiled where they run, and what happens where they cannot be."""

from __future__ import annotations

import ctypes
import logging
from itertools import product
from pathlib import Path

import pytest
import torch

from kornia_tidy import compiled as module
from kornia_tidy.compiled import compiled
from kornia_tidy.scene.direct import SOURCE
from tests.base import BaseTester

pytestmark = pytest.mark.skipif(compiled(SOURCE, torch.float32) is None, reason="no C compiler on this machine")


class TestCompiled(BaseTester):
    @pytest.fixture(autouse=True)
    def folder(self, tmp_path, monkeypatch, caplog):
        """An empty cache, and nothing remembered."""
        caplog.set_level(logging.INFO)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        compiled.cache_clear()
        yield tmp_path / "cache" / "kornia_tidy"
        compiled.cache_clear()

    @pytest.fixture
    def source(self, tmp_path):
        path = tmp_path / "twice.c"
        path.write_text("REAL twice(REAL x) { return 2 * x; }\n")
        return path

    def test_smoke(self, source):
        library = compiled(source, torch.float64)
        library.twice.restype, library.twice.argtypes = ctypes.c_double, (ctypes.c_double,)
        assert library.twice(1.25) == 2.5

    def test_feature_a_library_is_made_once_for_a_source_and_type(self, source, folder, monkeypatch):
        assert compiled(source, torch.float64) is compiled(source, torch.float64)
        compiled(source, torch.float32)
        assert len(list(folder.iterdir())) == 2
        compiled.cache_clear()
        monkeypatch.setattr(module, "_compile", lambda *_: pytest.fail("compiled again"))
        assert compiled(source, torch.float64) is not None
        source.write_text("REAL twice(REAL x) { return x + x; }\n")
        compiled.cache_clear()
        with pytest.raises(pytest.fail.Exception, match="compiled again"):
            compiled(source, torch.float64)

    def test_feature_only_the_user_may_write_to_the_folder(self, source, folder, caplog):
        compiled(source, torch.float32)
        assert folder.stat().st_mode & 0o777 == 0o700
        folder.chmod(0o777)
        compiled.cache_clear()
        assert compiled(source, torch.float32) is None
        assert "must belong to the user" in caplog.text

    def test_feature_no_compiler(self, source, monkeypatch, caplog):
        monkeypatch.delenv("CC", raising=False)
        monkeypatch.setenv("PATH", "")
        assert compiled(source, torch.float32) is None
        assert "no C compiler was found: twice.c is not used" in caplog.text

    def test_feature_a_compiler_that_cannot(self, source, folder, monkeypatch, caplog):
        for compiler, why in (("false", "twice.c did not compile"), ("/no/such/compiler", "No such file")):
            monkeypatch.setenv("CC", compiler)
            compiled.cache_clear()
            assert compiled(source, torch.float32) is None
            assert why in caplog.text
        assert not list(folder.iterdir())

    def test_feature_a_source_with_an_error(self, source, folder, caplog):
        source.write_text("REAL twice(REAL x) { return y; }\n")
        assert compiled(source, torch.float32) is None
        assert "twice.c did not compile" in caplog.text
        assert not list(folder.iterdir())

    def test_feature_a_folder_that_cannot_be_made(self, source, tmp_path, monkeypatch, caplog):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        assert compiled(source, torch.float32) is None
        assert "twice.c is not used" in caplog.text

    def test_feature_a_library_that_was_cut_short_is_no_crash(self, source, folder, monkeypatch, caplog):
        with monkeypatch.context() as patch:
            patch.setattr(ctypes, "CDLL", str)  # not loaded: one that is in use stays as it is
            compiled(source, torch.float32)
        next(folder.iterdir()).write_bytes(b"\x7fELF")
        compiled.cache_clear()
        assert compiled(source, torch.float32) is None
        assert "twice.c is not used" in caplog.text

    def test_feature_the_sources_of_the_package_have_no_warnings(self, monkeypatch, caplog):
        monkeypatch.setattr(module, "FLAGS", (*module.FLAGS, "-Wall", "-Wextra", "-Werror"))
        sources = sorted(Path(module.__file__).parent.rglob("*.c"))
        assert sources
        for source, dtype in product(sources, module.REALS):
            assert compiled(source, dtype) is not None, caplog.text
