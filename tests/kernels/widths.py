"""Widths of vectors that C sources are compiled with: the targets that have them, and those of this processor."""

from __future__ import annotations

import platform

from kornia_tidy.kernels.build import processor_features

# What /proc/cpuinfo calls what code for these processors uses.
V2 = frozenset({"sse4_2", "ssse3", "popcnt", "cx16"})
AVX2 = frozenset({"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"})
AVX512 = AVX2 | {"avx512f", "avx512bw", "avx512dq", "avx512vl"}

TARGETS = {16: "x86-64-v2", 32: "x86-64-v3", 64: "x86-64-v4"}  # by bytes of a vector
_NEEDS = {16: V2, 32: V2 | AVX2, 64: V2 | AVX512}


def options(width: int) -> tuple[str, ...]:
    """Return a compiler's options for vectors of some bytes; none on processors that have one width only."""
    return (f"-march={TARGETS[width]}",) if _is_x86() else ()


def widths_here() -> tuple[int, ...]:
    """Return the bytes of the vectors that this processor can compute with, narrow ones first."""
    if not _is_x86():
        return (16,)
    can = frozenset(processor_features().decode().split())
    return tuple(width for width, needs in _NEEDS.items() if needs <= can)


def _is_x86() -> bool:
    return platform.machine() in ("x86_64", "AMD64")
