"""Compiled libraries in a wheel: for which processors, which is loaded, whose threads it uses, what the wheel holds."""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

from kornia_tidy.kernels import build as module
from kornia_tidy.kernels.build import CompiledCodeWarning, build, compiled
from kornia_tidy.kernels.gather_ops import SOURCE
from kornia_tidy.kernels.make_libraries import make_library
from kornia_tidy.kernels.processor import LEVELS, levels, levels_here
from tests.base import BaseTester
from tests.kernels.test_build import CompiledTester, forget

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("auditwheel", "build", "hatchling")  # patchelf, which auditwheel asks for, is no module
can_compile = bool(levels_here()) and build(SOURCE, torch.float32).threads
can_make = can_compile and all(importlib.util.find_spec(name) for name in TOOLS)
EVERY = list(next((names for names in LEVELS.values() if set(levels_here()) & set(names)), ()))  # on such machines

# What Linux lists of processors, without features that belong to no level.
CORE_2 = "fpu mmx fxsr sse sse2 ht pni ssse3 cx16 sse4_1 lahf_lm"
NEHALEM = f"{CORE_2} sse4_2 popcnt"
SANDY_BRIDGE = f"{NEHALEM} xsave avx aes pclmulqdq"
HASWELL = f"{SANDY_BRIDGE} fma movbe f16c rdrand abm bmi1 avx2 smep bmi2 erms"
ALDER_LAKE = f"{HASWELL} adx clflushopt sha_ni xsaveopt xsavec avx_vnni gfni vaes vpclmulqdq"
KNIGHTS_LANDING = f"{HASWELL} adx avx512f avx512pf avx512er avx512cd"
SKYLAKE_SERVER = f"{HASWELL} mpx adx avx512f avx512dq avx512cd avx512bw avx512vl xsaveopt"
ZEN_1 = f"{HASWELL} sse4a misalignsse 3dnowprefetch adx sha_ni clzero"
ZEN_4 = f"{ZEN_1} avx512f avx512dq avx512ifma avx512cd avx512bw avx512vl avx512_bf16 avx512vbmi gfni vaes"
K8 = "fpu mmx fxsr sse sse2 ht syscall nx mmxext lm 3dnowext 3dnow pni"
NEOVERSE_N1 = "fp asimd evtstrm aes pmull sha1 sha2 crc32 atomics fphp asimdhp cpuid asimdrdm lrcpc dcpop asimddp ssbs"


class TestLevels(BaseTester):
    @pytest.mark.parametrize(
        ("machine", "features", "best"),
        [
            ("x86_64", "", None),
            ("x86_64", K8, None),
            ("x86_64", CORE_2, None),
            ("x86_64", NEHALEM, "x86-64-v2"),
            ("x86_64", SANDY_BRIDGE, "x86-64-v2"),
            ("x86_64", HASWELL, "x86-64-v3"),
            ("x86_64", HASWELL.replace(" fma", ""), "x86-64-v2"),  # as some virtual machines hide them
            ("x86_64", HASWELL.replace(" avx2", "").replace(" avx", ""), "x86-64-v2"),  # a system without AVX's state
            ("x86_64", ALDER_LAKE, "x86-64-v3"),
            ("x86_64", KNIGHTS_LANDING, "x86-64-v3"),
            ("x86_64", SKYLAKE_SERVER, "x86-64-v4"),
            ("x86_64", ZEN_1, "x86-64-v3"),
            ("x86_64", ZEN_4, "x86-64-v4"),
            ("x86_64", NEOVERSE_N1, None),  # an emulator that shows the processor below it
            ("aarch64", NEOVERSE_N1, "armv8-a"),
            ("arm64", "", None),  # macOS
            ("riscv64", "", None),
        ],
    )
    def test_feature_the_best_level_of_processors(self, machine, features, best):
        assert next(iter(levels(machine, frozenset(features.split()))), None) == best

    @pytest.mark.skipif(not Path("/lib64/ld-linux-x86-64.so.2").exists(), reason="no loader for x86-64 here")
    def test_feature_levels_of_this_processor_as_the_c_library_finds_them(self):
        told = subprocess.run(["/lib64/ld-linux-x86-64.so.2", "--help"], capture_output=True, text=True, check=False)
        if "x86-64-v2" not in told.stdout:
            pytest.skip("this C library does not tell levels of processors")
        assert levels_here() == re.findall(r"(x86-64-v\d) \(supported", told.stdout)


@pytest.mark.skipif(not can_compile, reason="no C compiler on this machine, or no wheels for its processor")
class WheelTester(CompiledTester):
    @pytest.fixture
    def wheel(self, source):
        """A folder of libraries beside a source, each of which tells its rank, all of which this processor can run."""
        folder = source.parent / module.LIBRARIES
        folder.mkdir()
        text = source.read_text()
        for rank, level in enumerate(EVERY):
            source.write_text(f"{text}int rank(void) {{ return {rank}; }}\n")
            made = make_library(source, torch.float64, levels_here()[-1], source.parent)
            made.rename(folder / f"twice-double-{level}.so")
        source.write_text(f"{text}int rank(void) {{ return -1; }}\n")
        forget()
        return folder


class TestWheel(WheelTester):
    def test_feature_needs_neither_a_compiler_nor_a_cache(self, wheel, source, folder, monkeypatch):
        monkeypatch.setenv("PATH", "")
        built = build(source, torch.float64)
        assert self.twice(built.library) == 2.5
        assert (built.origin, built.threads, built.remark) == (f"from the wheel, for {levels_here()[0]}", True, "")
        assert not folder.exists()

    @pytest.mark.parametrize("rank", range(3))
    def test_feature_the_best_level_that_the_processor_runs_is_loaded(self, rank, wheel, source, monkeypatch):
        if rank >= len(EVERY):
            pytest.skip(f"{EVERY} are all levels of this kind of processor")
        monkeypatch.setattr(module, "levels_here", lambda: EVERY[rank:])
        assert compiled(source, torch.float64).rank() == rank

    def test_feature_a_processor_below_all_levels_takes_the_compiler(self, wheel, source, monkeypatch):
        monkeypatch.setattr(module, "levels_here", list)
        assert compiled(source, torch.float64).rank() == -1
        monkeypatch.setenv("PATH", "")
        forget()
        words = "the wheel's libraries need a newer processor; no C compiler was found: install gcc or clang"
        with pytest.warns(CompiledCodeWarning, match=words):
            assert compiled(source, torch.float64) is None

    def test_feature_a_library_that_cannot_be_loaded_gives_way_to_the_compiler(self, wheel, source):
        for path in wheel.iterdir():
            path.write_bytes(b"no library")
        built = build(source, torch.float64)
        assert built.library.rank() == -1
        assert "twice.c: " in built.remark

    def test_feature_a_compiler_that_is_named_is_preferred(self, wheel, source, monkeypatch):
        monkeypatch.setenv("CC", "cc")
        assert compiled(source, torch.float64).rank() == -1

    def test_feature_the_wheel_stands_in_for_a_named_compiler_that_fails(self, wheel, source, monkeypatch):
        monkeypatch.setenv("CC", "false")
        assert compiled(source, torch.float64).rank() >= 0
        assert build(source, torch.float64).remark == "the C compiler false failed (status 1): no word"


class TestThreads(WheelTester):
    """A second OpenMP library in the process would keep threads of its own, and know nothing of torch's settings."""

    @pytest.fixture
    def library(self, source) -> Path:
        source.write_text(
            "#include <omp.h>\n"
            "int most(void) { return omp_get_max_threads(); }\n"
            "int used(int n) { int k = 0;\n#pragma omp parallel num_threads(n) reduction(+ : k)\nk++; return k; }\n"
        )
        folder = source.parent / module.LIBRARIES
        folder.mkdir()
        return make_library(source, torch.float64, levels_here()[0], folder)

    def test_feature_the_threads_are_torchs(self, library, source):
        before = torch.get_num_threads()
        built = build(source, torch.float64)
        assert built.path == library
        try:
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                assert built.library.most() == threads
                assert built.library.used(threads) == threads
        finally:
            torch.set_num_threads(before)

    def test_feature_a_torch_that_keeps_openmp_for_itself(self, library, tmp_path):
        """As builds of torch may that link to it otherwise: a process without torch stands for it."""
        try:
            ctypes.CDLL("libgomp.so.1")
        except OSError:
            pytest.skip("there is no libgomp.so.1 beside torch's on this machine")
        code = (
            "import ctypes, sys, types; from pathlib import Path\n"
            "torch = sys.modules['torch'] = types.ModuleType('torch'); torch.float32 = 'f'; torch.float64 = 'd'\n"
            "torch.dtype = str; package = sys.modules['kornia_tidy'] = types.ModuleType('kornia_tidy')\n"
            f"package.__path__ = [{str(ROOT / 'kornia_tidy')!r}]\n"
            "assert not hasattr(ctypes.CDLL(None), 'GOMP_parallel')\n"
            "from kornia_tidy.kernels.build import build\n"
            f"built = build(Path({str(library.parent.parent / 'twice.c')!r}), 'd')\n"
            "assert built.path.parent.name == 'libraries' and built.library.used(2) == 2, built\n"
        )
        subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


# A capture and its gradient by the libraries of the wheel, for each level, and what they came from.
CAPTURES = """
import json, sys, torch
from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.data import dead_leaves
from kornia_tidy.kernels import build
level = sys.argv[1]
if level != "compiled":
    build.levels_here = lambda: [level]
image, depth = dead_leaves(96, 96, num_leaves=300)
masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(2))
captures = []
for compositing in ("gather", "occlusion"):
    for dtype in build.REALS:
        optics = TiDyOptics(masks, compositing=compositing, sensor=None).to(dtype)
        with torch.no_grad():
            captures.append(optics(image.to(dtype), depth.to(dtype)))
        optics(image.to(dtype), depth.to(dtype)).square().sum().backward()
        captures += [mask.grad.clone() for mask in masks.parameters()]
        masks.zero_grad()
origins = {build.build(s, d).origin for s in build.KERNELS.glob("*.c") for d in build.REALS}
torch.save(captures, sys.argv[2])
print(json.dumps(sorted(origins)))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """The wheel that `make wheel` would leave in dist/."""
    folder = tmp_path_factory.mktemp("wheel")
    tools = os.path.dirname(sys.executable) + os.pathsep + os.environ["PATH"]
    environment = {**os.environ, "PATH": tools, "KORNIA_TIDY_LIBRARIES": str(folder / "libraries")}

    def run(name: str, *arguments: str | Path) -> None:
        words = [sys.executable, "-m", name, *map(str, arguments)]
        subprocess.run(words, check=True, env=environment, cwd=ROOT)

    run("kornia_tidy.kernels.make_libraries", folder / "libraries")
    run("build", "--wheel", "--no-isolation", "--outdir", folder / "built", ROOT)
    run("auditwheel", "repair", "--wheel-dir", folder, *(folder / "built").glob("*.whl"))
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(not can_make, reason="needs Linux and what `make wheel` installs")
class TestMake(CompiledTester):
    """`make wheel`: as the Makefile does it, without its environment."""

    def test_feature_a_wheel_for_a_platform_and_any_python(self, made):
        assert re.fullmatch(r"kornia_tidy-[\d.]+-py3-none-manylinux.*_\d+_\d+_(x86_64|aarch64)\.whl", made.name)
        with zipfile.ZipFile(made) as archive:
            names = [Path(name) for name in archive.namelist()]
            (about,) = (name for name in archive.namelist() if name.endswith(".dist-info/WHEEL"))
            assert "Root-Is-Purelib: false" in archive.read(about).decode()
        libraries = {path.name for path in names if path.suffix == ".so"}
        sources = {path.stem for path in names if path.suffix == ".c"}
        assert libraries == {
            f"{s}-{real}-{level}.so" for s in sources for real in module.REALS.values() for level in EVERY
        }
        assert {path.parent.as_posix() for path in names if path.suffix == ".so"} == {"kornia_tidy/kernels/libraries"}

    def test_feature_each_level_that_runs_here_gives_the_capture_of_the_compiler(self, made, tmp_path):
        """The compiler's library in this checkout; the wheel unpacked, with no compiler and an empty cache."""
        with zipfile.ZipFile(made) as archive:
            archive.extractall(tmp_path / "installed")

        def captures(name: str, root: Path, **changes: str) -> tuple[list[str], list[torch.Tensor]]:
            environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", **changes}
            command = [sys.executable, "-c", CAPTURES, name, str(tmp_path / f"{name}.pt")]
            done = subprocess.run(command, check=True, env=environment, cwd=tmp_path, capture_output=True, text=True)
            return json.loads(done.stdout), torch.load(tmp_path / f"{name}.pt")

        (origin,), expected = captures("compiled", ROOT)
        assert origin.startswith("compiled for this processor by ")
        for level in levels_here():
            cache = tmp_path / "empty"
            origins, got = captures(level, tmp_path / "installed", PATH="", XDG_CACHE_HOME=str(cache))
            assert origins == [f"from the wheel, for {level}"]
            assert not list(cache.rglob("*.so"))
            for ours, theirs in zip(got, expected, strict=True):
                self.assert_close(ours / theirs.abs().max(), theirs / theirs.abs().max(), rtol=0, atol=1e-6)

    def test_feature_without_libraries_the_wheel_is_pure(self, tmp_path):
        """As `pip install .` makes it, with a compiler or without."""
        environment = {name: value for name, value in os.environ.items() if name != "KORNIA_TIDY_LIBRARIES"}
        command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
        subprocess.run(command, check=True, env={**environment, "PATH": ""}, cwd=ROOT)
        (wheel,) = tmp_path.glob("*.whl")
        assert wheel.name.endswith("-py3-none-any.whl")
        with zipfile.ZipFile(wheel) as archive:
            assert not [name for name in archive.namelist() if name.endswith(".so")]
