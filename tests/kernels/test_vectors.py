"""Vectors as wide as a register of the processor: the width of a target, and the same numbers at all widths."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.kernels import build as module
from kornia_tidy.kernels.build import build, find_compiler, target_vector_bytes, vector_bytes
from tests.kernels.kernel_shapes import DTYPES
from tests.kernels.test_build import CompiledTester, forget
from tests.kernels.widths import TARGETS, options

compiles = pytest.mark.skipif(
    build(module.KERNELS / "direct.c", torch.float32).library is None, reason="no C compiler on this machine"
)
on_x86 = pytest.mark.skipif(not options(16), reason="this processor has one width of vectors")


@compiles
class TestVectors(CompiledTester):
    @pytest.fixture
    def source(self, tmp_path):
        path = tmp_path / "lanes.c"
        path.write_text('#include "vectors.h"\nint lanes(void) { return LANES; }\n')
        return path

    def compiler_for(self, target: str, tmp_path, monkeypatch) -> None:
        """Let the C compiler be one that targets a processor without being told to in its options."""
        monkeypatch.setenv("CC", self.compiler(tmp_path / "mine", f'exec cc "$@" -march={target}'))
        forget()
        target_vector_bytes.cache_clear()

    @on_x86
    @pytest.mark.parametrize(
        ("target", "width"),
        [*((target, width) for width, target in TARGETS.items()), ("x86-64", 16), ("ivybridge", 32), ("znver1", 32)],
    )
    @pytest.mark.parametrize("real", DTYPES)
    def test_feature_the_width_is_that_of_the_targets_registers(self, target, width, real, source, monkeypatch):
        """By the processors' manuals: 64 bytes with AVX-512, 32 with AVX (Ivy Bridge has no AVX2), 16 with SSE2."""
        monkeypatch.setenv("CC", f"cc -march={target}")
        forget()
        built = build(source, real)
        assert vector_bytes(built.library) == target_vector_bytes(find_compiler()) == width
        assert built.library.lanes() == width // real.itemsize  # a return of a number: any processor can run it

    @on_x86
    def test_feature_another_width_is_another_library(self, source, folder, tmp_path, monkeypatch):
        """Also where the compiler is the same to the letter, such as a wrapper with a file of options."""
        for width, target in TARGETS.items():
            self.compiler_for(target, tmp_path, monkeypatch)
            assert vector_bytes(build(source, torch.float32).library) == width
            assert f"-{width}-" in build(source, torch.float32).path.name
        assert len(list(folder.iterdir())) == len(TARGETS)
