"""C sources that are compiled where they run, loaded only if whole and the user's own, and what happens where not."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import pytest
import torch

from kornia_tidy.kernels import build as module
from kornia_tidy.kernels import compiler as compiler_module
from kornia_tidy.kernels.build import CompiledCodeWarning, build, compiled
from kornia_tidy.kernels.compiler import find_compiler
from kornia_tidy.kernels.gather_ops import SOURCE
from tests.base import BaseTester

pytestmark = pytest.mark.skipif(build(SOURCE, torch.float32).library is None, reason="no C compiler on this machine")
MEMORIES = (compiled, build, find_compiler, compiler_module.why_no_threads)


def forget() -> None:
    """Let everything be found anew, as in a new process."""
    for memory in MEMORIES:
        memory.cache_clear()
    compiler_module._hung.clear()
    module._warned.clear()


class CompiledTester(BaseTester):
    @pytest.fixture(autouse=True)
    def folder(self, tmp_path, monkeypatch):
        """An empty cache, and nothing remembered."""
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
        monkeypatch.delenv("CC", raising=False)
        forget()
        yield tmp_path / "cache" / "kornia_tidy"
        forget()

    @pytest.fixture
    def source(self, tmp_path):
        path = tmp_path / "twice.c"
        path.write_text("REAL twice(REAL x) { return 2 * x; }\n")
        return path

    @staticmethod
    def compiler(path: Path, body: str) -> str:
        """Write a shell script in place of a compiler."""
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(0o755)
        return str(path)

    @staticmethod
    def twice(library: ctypes.CDLL) -> float:
        library.twice.restype, library.twice.argtypes = ctypes.c_double, (ctypes.c_double,)
        return library.twice(1.25)


class TestCompiled(CompiledTester):
    def test_smoke(self, source):
        assert self.twice(compiled(source, torch.float64)) == 2.5

    def test_feature_a_library_is_made_once_for_a_source_and_type(self, source, folder, monkeypatch):
        assert compiled(source, torch.float64) is compiled(source, torch.float64)
        compiled(source, torch.float32)
        assert len(list(folder.iterdir())) == 2
        forget()
        monkeypatch.setattr(module, "_compile", lambda *_: pytest.fail("compiled again"))
        assert compiled(source, torch.float64) is not None
        source.write_text("REAL twice(REAL x) { return x + x; }\n")
        forget()
        with pytest.raises(pytest.fail.Exception, match="compiled again"):
            compiled(source, torch.float64)

    @pytest.mark.takes_seconds
    def test_feature_the_sources_of_the_package_have_no_warnings(self, monkeypatch):
        monkeypatch.setattr(module, "FLAGS", (*module.FLAGS, "-Wall", "-Wextra", "-Werror"))
        sources = sorted(Path(module.__file__).parent.rglob("*.c"))
        assert sources
        for source, dtype in product(sources, module.REALS):
            assert build(source, dtype).remark == ""


class TestCompiler(CompiledTester):
    """What `$CC` may say, and compilers that cannot."""

    def test_feature_options_stand_last(self, source, monkeypatch):
        source.write_text("REAL twice(REAL x) { return FACTOR * x; }\n")
        monkeypatch.setenv("CC", "cc -pthread -DFACTOR=4")
        assert find_compiler().options == ("-pthread", "-DFACTOR=4")
        assert self.twice(compiled(source, torch.float64)) == 5.0

    def test_feature_a_wrapper_before_the_compiler(self, source, tmp_path, monkeypatch):
        wrapper = self.compiler(tmp_path / "ccache", 'exec "$@"')
        monkeypatch.setenv("CC", f"{wrapper} cc -O1")
        assert find_compiler().program[1:] == ("cc",)
        assert self.twice(compiled(source, torch.float64)) == 2.5

    def test_feature_another_version_is_another_library(self, source, tmp_path, folder, monkeypatch):
        for version in ("1.0", "2.0"):
            body = f'case "$1" in --version) echo mine {version};; *) exec cc "$@";; esac'
            monkeypatch.setenv("CC", self.compiler(tmp_path / "mine", body))
            forget()
            assert compiled(source, torch.float64) is not None
            assert find_compiler().version == f"mine {version}"
        assert len(list(folder.iterdir())) == 2

    @pytest.mark.parametrize(
        ("compiler", "why"),
        [
            ("false", r"the C compiler false failed \(status 1\): no word"),
            ("/no/such/compiler", "the C compiler /no/such/compiler cannot be started: No such file"),
            ("gcc 'oh", "is no command: No closing quotation"),
        ],
    )
    def test_exception_a_compiler_that_cannot_is_told_once(self, compiler, why, source, folder, monkeypatch):
        monkeypatch.setenv("CC", compiler)
        with pytest.warns(CompiledCodeWarning, match=why) as told:
            assert [compiled(source, dtype) for dtype in module.REALS] == [None, None]
        assert len(told) == 1
        assert "takes 2 to 6 times as long" in str(told[0].message)
        assert not folder.exists() or not list(folder.iterdir())

    def test_exception_no_compiler(self, source, monkeypatch):
        monkeypatch.setenv("PATH", "")
        words = (
            "no C compiler was found: install gcc or clang.*; the wheel that `make wheel` makes .* needs no compiler"
        )
        with pytest.warns(CompiledCodeWarning, match=words):
            assert compiled(source, torch.float32) is None

    @pytest.mark.parametrize("command", ["./mine", "tools/mine", "nowhere-on-the-path"])
    def test_exception_a_compiler_of_the_current_folder(self, command, source, tmp_path, monkeypatch):
        (tmp_path / "tools").mkdir()
        for path in (tmp_path / "mine", tmp_path / "tools" / "mine"):
            self.compiler(path, f'touch {tmp_path}/started; exec cc "$@"')
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("CC", command)
        with pytest.warns(CompiledCodeWarning, match=f"the C compiler {command} of .CC is in no absolute"):
            assert compiled(source, torch.float32) is None
        assert not (tmp_path / "started").exists()

    @pytest.mark.parametrize("command", ["", "gcc", "env gcc"])
    @pytest.mark.parametrize("entry", ["", ".", "tools"])
    def test_feature_nothing_in_the_current_folder_is_started(self, entry, command, source, tmp_path, monkeypatch):
        here = tmp_path / "downloaded"
        (here / "tools").mkdir(parents=True)
        for folder, name in product((here, here / "tools"), ("cc", "gcc", "clang", "env", "as", "ld")):
            self.compiler(folder / name, f"touch {tmp_path}/started; exit 1")
        (here / "stdint.h").write_text("#error a header of the current folder\n")
        source.write_text(f"#include <stdint.h>\n{source.read_text()}")
        monkeypatch.chdir(here)
        for name in ("PATH", "CPATH", "C_INCLUDE_PATH", "COMPILER_PATH", "LIBRARY_PATH"):
            monkeypatch.setenv(name, os.pathsep.join((entry, os.environ.get(name, ""))))
        monkeypatch.setenv("CC", command)
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert not (tmp_path / "started").exists()

    def test_exception_a_source_with_an_error(self, source, folder):
        source.write_text("REAL twice(REAL x) { return y; }\n")
        with pytest.warns(CompiledCodeWarning, match="error: .y. undeclared|error: use of undeclared"):
            assert compiled(source, torch.float32) is None
        assert not list(folder.iterdir())

    def test_exception_one_that_hangs_is_ended_with_its_children(self, source, tmp_path, monkeypatch):
        child = tmp_path / "child"
        script = self.compiler(tmp_path / "hangs", f"sleep 1000 & echo $! > {child}; wait")
        monkeypatch.setenv("CC", script)
        monkeypatch.setattr(compiler_module, "SECONDS", 0.5)
        with pytest.warns(CompiledCodeWarning, match=r"hangs was ended, since it took more than 0.5 s"):
            assert compiled(source, torch.float32) is None
        process = int(child.read_text())
        deadline = time.monotonic() + 30
        while _is_running(process) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not _is_running(process)
        child.unlink()
        assert compiled(source, torch.float64) is None
        assert not child.exists()  # it was not called again

    def test_feature_a_compiler_without_openmp_is_told(self, source, tmp_path, monkeypatch):
        body = 'case "$*" in *fopenmp*) echo "error: cannot find -lomp" >&2; exit 1;; *) exec cc "$@";; esac'
        monkeypatch.setenv("CC", self.compiler(tmp_path / "mine", body))
        with pytest.warns(CompiledCodeWarning, match="compiled code runs in one thread: .*cannot find -lomp"):
            assert self.twice(compiled(source, torch.float64)) == 2.5
        assert not build(source, torch.float64).threads


class TestCache(CompiledTester):
    """Libraries that are not whole or not the user's own, and folders that cannot be used."""

    def damaged(self, source: Path, folder: Path, damage) -> Path:
        """Compile without loading a library, damage the cached file, and clear the cache in memory."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ctypes, "CDLL", str)
            compiled(source, torch.float64)
        (path,) = folder.iterdir()
        damage(path)
        forget()
        return path

    @pytest.mark.parametrize("left", [0, 4, 4096, -1])
    def test_feature_a_library_that_was_cut_is_built_again(self, left, source, folder):
        def cut(path):
            path.write_bytes(path.read_bytes()[:left])

        path = self.damaged(source, folder, cut)
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert list(folder.iterdir()) == [path]

    def test_feature_a_library_that_others_may_write_to_is_built_again(self, source, folder):
        path = self.damaged(source, folder, lambda path: path.chmod(0o777))
        before = path.stat().st_ino, path.stat().st_mtime_ns
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert path.stat().st_mode & 0o077 == 0
        assert (path.stat().st_ino, path.stat().st_mtime_ns) != before

    @pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give files away")
    def test_feature_a_library_of_somebody_else_is_built_again(self, source, folder):
        path = self.damaged(source, folder, lambda path: os.chown(path, 12345, 12345))
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert path.stat().st_uid == 0

    def test_feature_a_link_is_not_followed(self, source, folder, tmp_path):
        def move(path):
            path.rename(tmp_path / "elsewhere.so")
            path.symlink_to(tmp_path / "elsewhere.so")

        path = self.damaged(source, folder, move)
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert not path.is_symlink()

    def test_feature_only_the_user_may_write_to_the_folder(self, source, folder, tmp_path):
        compiled(source, torch.float32)
        assert folder.stat().st_mode & 0o777 == 0o700
        folder.chmod(0o777)
        forget()
        path = build(source, torch.float32).path
        assert path.parent.parent == tmp_path  # a private temporary folder instead
        assert path.parent.stat().st_mode & 0o777 == 0o700

    @pytest.mark.parametrize("moment", ["lstat", "digest", "load"])
    def test_feature_a_library_that_is_removed_meanwhile_is_built_again(self, moment, source, folder, monkeypatch):
        """By another process, at any moment between finding its name and loading it."""
        path = self.damaged(source, folder, lambda path: None)
        owner, name = {"lstat": (Path, "lstat"), "digest": (module, "_content_digest"), "load": (ctypes, "CDLL")}[
            moment
        ]
        original, removed = getattr(owner, name), []

        def remove_first(given, *args, **options):
            if Path(given) == path and not removed:
                removed.append(path.unlink())
            return original(given, *args, **options)

        monkeypatch.setattr(owner, name, remove_first)
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert removed
        assert build(source, torch.float64).threads
        assert list(folder.iterdir()) == [path]

    def test_feature_a_cache_that_is_removed_while_the_compiler_runs_is_made_again(
        self, source, folder, tmp_path, monkeypatch
    ):
        body = (
            f'case "$*" in *library.so*) [ -e {tmp_path}/once ] || {{ touch {tmp_path}/once; rm -r {folder}; }};; esac'
        )
        monkeypatch.setenv("CC", self.compiler(tmp_path / "mine", f'{body}\nexec cc "$@"'))
        assert self.twice(compiled(source, torch.float64)) == 2.5
        assert (tmp_path / "once").exists()
        assert build(source, torch.float64).path.parent == folder

    def test_feature_a_cache_that_is_removed_between_two_sources_is_made_again(self, source, folder):
        assert compiled(source, torch.float32) is not None
        shutil.rmtree(folder.parent)
        assert self.twice(compiled(source, torch.float64)) == 2.5

    @pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "HOME"])
    def test_feature_a_relative_cache_folder_is_ignored(self, variable, source, tmp_path, monkeypatch):
        """It would be another one in each folder, and may have come with a download."""
        (tmp_path / "here").mkdir()
        monkeypatch.chdir(tmp_path / "here")
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        monkeypatch.setenv("XDG_CACHE_HOME", "")
        monkeypatch.setenv(variable, "cache")
        built = build(source, torch.float64)
        assert self.twice(built.library) == 2.5
        expected = tmp_path / "home" / ".cache" if variable == "XDG_CACHE_HOME" else tmp_path
        assert built.path.parent.parent == expected
        assert not list((tmp_path / "here").iterdir())

    @pytest.mark.parametrize("why", ["no home", "a file in its place"])
    def test_feature_without_a_cache_folder_a_temporary_one_serves(self, why, source, tmp_path, monkeypatch):
        def no_home():
            raise RuntimeError("Could not determine home directory.")

        if why == "no home":  # such as `docker run --user 12345`
            monkeypatch.delenv("XDG_CACHE_HOME")
            monkeypatch.setattr(Path, "home", no_home)
        else:
            (tmp_path / "file").write_text("")
            monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        built = build(source, torch.float64)
        assert self.twice(built.library) == 2.5
        assert built.path.parent.parent == tmp_path

    def test_exception_no_folder_at_all(self, source, tmp_path, monkeypatch):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        monkeypatch.setattr(module.tempfile, "gettempdir", lambda: str(tmp_path / "file"))
        with pytest.warns(CompiledCodeWarning, match="twice.c"):
            assert compiled(source, torch.float64) is None

    @pytest.mark.takes_seconds
    def test_feature_several_processes_at_once_leave_whole_libraries(self, source, folder):
        lines = (
            "from pathlib import Path",
            "import torch",
            "from kornia_tidy.kernels.build import compiled",
            f"compiled(Path({str(source)!r}), torch.float64).twice",
        )
        command = [sys.executable, "-c", "; ".join(lines)]
        for process in [subprocess.Popen(command) for _ in range(3)]:
            assert process.wait(120) == 0
        paths = list(folder.iterdir())
        assert paths
        assert all(path.name.endswith(f"{module._content_digest(path)}.so") for path in paths)


def _is_running(process: int) -> bool:
    """Whether a process is there, and not merely waiting to be collected."""
    try:
        return " Z " not in Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return shutil.which("kill") is None
