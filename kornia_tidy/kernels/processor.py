"""The processor's features by the system, and the levels of processors with loadable compiled code.

A level is a set of instructions for a compiler (``-march=``): x86-64-v2 is SSE4.2, v3 is AVX2 with FMA, v4 is AVX-512;
each 64-bit ARM processor runs ``armv8-a``, with NEON. Linux tells a feature only if it saves its registers between
threads, so that no other test of the system is needed.

Source: x86-64 psABI, micro-architecture levels; Linux, ``cpufeatures.h``, for the names of features.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

V2 = frozenset({"cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3"})  # pni is SSE3
V3 = V2 | {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "xsave"}  # abm is LZCNT
V4 = V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
LEVELS = {
    "x86_64": {"x86-64-v4": V4, "x86-64-v3": V3, "x86-64-v2": V2},
    "aarch64": {"armv8-a": frozenset({"fp", "asimd"})},
}  # by machine, the best first


def levels(machine: str, features: frozenset[str]) -> list[str]:
    """Return the levels that a processor can run, the best first.

    Args:
        machine: as :func:`platform.machine` tells it.
        features: as ``/proc/cpuinfo`` lists them.

    Example:
        >>> levels("x86_64", V3 | {"avx512f"})
        ['x86-64-v3', 'x86-64-v2']
    """
    return [level for level, needed in LEVELS.get(machine, {}).items() if needed <= features]


@cache
def levels_here() -> list[str]:
    """Return the levels that this machine can run, the best first; none where Linux does not tell."""
    lines = processor_features().decode(errors="replace").splitlines()
    told = (line.partition(":")[2] for line in lines if line.startswith(("flags", "Features")))
    return levels(platform.machine(), frozenset(next(told, "").split()))


@cache
def processor_features() -> bytes:
    """Return the processor's model and instruction sets: unlike machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().split(b"\n\n")[0].splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}".encode()
    kept = (b"model name", b"flags", b"Features", b"CPU part")
    return b"\n".join(line for line in lines if line.startswith(kept))
