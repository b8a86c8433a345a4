"""Portability tests: the test suite under the conditions of other machines, one factor at a time, with a table.

``python -m tests.portable`` takes up to 30 minutes on two cores; ``--quick`` takes a share of it, ``--only aten`` the
factors whose names begin so, and ``--list`` shows them all. ``--only widths``, which the quick run leaves out, compares
the widths of vectors that the processor can run, with one another and with no compiler: results and speed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.benchmarks import vector_widths
from tests.kernels.widths import AVX2, AVX512, V2

ROOT = Path(__file__).resolve().parents[1]

KERNELS = (
    "tests/kernels/test_gather_ops.py",
    "tests/kernels/test_mutual_intensity_ops.py",
    "tests/kernels/test_occlusion_ops.py",
    "tests/kernels/test_scattered_ops.py",
    "tests/render/backends/test_compiled.py",
    "tests/psf/test_energies.py",
)
COMPILED = (  # what calls the C kernels
    "tests/kernels",
    "tests/render",
    "tests/psf",
    "tests/camera/test_lens_captures.py",
    "tests/camera/test_tidy_optics.py",
    "tests/camera/test_motion.py",
    "tests/camera/test_burst.py",
    "tests/accuracy/test_error_model.py",
    "tests/accuracy/test_rendering_cost.py",
    "tests/camera/test_pipelines_captures.py",
    "tests/camera/test_published_systems.py",
)
TRANSFORMS = (  # and matrix products
    *COMPILED,
    "tests/optics",
    "tests/masks",
    "tests/modulator",
    "tests/design",
    "tests/lab/calibration",
    "tests/reconstruction/test_tikhonov.py",
    "tests/reconstruction/test_tikhonov_modules.py",
    "tests/reconstruction/test_periodic.py",
    "tests/reconstruction/test_refocused.py",
    "tests/accuracy/test_planner.py",
)
NUMBERS = (
    *TRANSFORMS,
    "tests/reconstruction",
    "tests/sensor",
    "tests/lab/raw",
    "tests/training/test_designed.py",
    "tests/training/test_evaluation.py",
    "tests/training/test_module.py",
    "tests/training/test_noisy_crops.py",
    "tests/training/test_parts.py",
    "tests/reconstruction/test_pretrained.py",
)

WIDTHS = "widths"  # of vectors, compared with one another: not a factor that tests run under

# Prints, in the environment of a factor, the vector width, compiler and threads in use.
PROBE = """
import hashlib, json, warnings
import torch
from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.compiler import NotBuiltError, find_compiler
from kornia_tidy.kernels.gather_ops import SOURCE
warnings.simplefilter("ignore")
try:
    compiler = find_compiler()
    compiler = " ".join([*compiler.version.split()[1:], *compiler.options])  # the first word is the program's name
except NotBuiltError:
    compiler = "none"
generator = torch.Generator().manual_seed(0)
one, two = torch.rand(2, 96, 96, generator=generator, dtype=torch.float64)
products = torch.cat([one @ two, torch.linalg.inv(one), torch.fft.fft2(two).real])
print(json.dumps({
    "aten": torch.backends.cpu.get_cpu_capability(),
    "mkl": hashlib.sha256(products.numpy().tobytes()).hexdigest() if torch.backends.mkl.is_available() else "",
    "compiled": compiled(SOURCE, torch.float32) is not None,
    "threads": torch.get_num_threads(),
    "compiler": compiler,
}))
"""


@dataclass(frozen=True)
class Machine:
    """Processor of this machine, with the vector width, compiler and threads used by default."""

    processor: str
    can: frozenset[str]
    usual: dict[str, object]


@dataclass(frozen=True)
class Factor:
    """One thing in which machines differ.

    Args:
        name: of it, in the table.
        environment: what makes this machine differ so.
        tests: that it can touch.
        quick: those of the quick run; none leaves it out.
        needs: what the processor must be able to do.
        compiler: the program that must be there.
        refuse: why what is in use there is not what was asked for, or None; given the machine and what is in use.
    """

    name: str
    environment: dict[str, str]
    tests: tuple[str, ...]
    quick: tuple[str, ...] = ()
    needs: frozenset[str] = frozenset()
    compiler: str = ""
    refuse: Callable[[Machine, dict[str, object]], str | None] = field(default=lambda machine, used: None)


def _not_aten(level: str) -> Callable[[Machine, dict[str, object]], str | None]:
    def refuse(_: Machine, used: dict[str, object]) -> str | None:
        return None if used["aten"] == level else f"PyTorch uses {used['aten']} nevertheless"

    return refuse


def _same_mkl(machine: Machine, used: dict[str, object]) -> str | None:
    if not used["mkl"]:
        return "this PyTorch is without oneMKL"
    same = used["mkl"] == machine.usual.get("mkl")
    return f"oneMKL computes to the last bit as without it on this processor ({machine.processor})" if same else None


def _not_compiled(_: Machine, used: dict[str, object]) -> str | None:
    return None if used["compiled"] else "the compiler does not compile the C sources so"


def _compiled(_: Machine, used: dict[str, object]) -> str | None:
    return "the C sources are compiled nevertheless" if used["compiled"] else None


def _one_core(_: Machine, used: dict[str, object]) -> str | None:
    return None if used["threads"] == 2 else f"PyTorch uses {used['threads']} threads"


def _c(name: str, compiler: str, *options: str, needs: frozenset[str] = frozenset(), quick: bool = False) -> Factor:
    environment = {"CC": " ".join((compiler, *options))}
    return Factor(name, environment, COMPILED, KERNELS if quick else (), needs, compiler, _not_compiled)


FACTORS = (
    Factor("aten default", {"ATEN_CPU_CAPABILITY": "default"}, NUMBERS, ("tests/render",), refuse=_not_aten("DEFAULT")),
    Factor("aten avx2", {"ATEN_CPU_CAPABILITY": "avx2"}, NUMBERS, (), AVX2, refuse=_not_aten("AVX2")),
    Factor("aten avx512", {"ATEN_CPU_CAPABILITY": "avx512"}, NUMBERS, (), AVX512, refuse=_not_aten("AVX512")),
    Factor("onemkl avx2", {"MKL_ENABLE_INSTRUCTIONS": "AVX2"}, TRANSFORMS, (), AVX2, refuse=_same_mkl),
    Factor("onemkl compatible", {"MKL_CBWR": "COMPATIBLE"}, TRANSFORMS, KERNELS, refuse=_same_mkl),
    _c("c x86-64-v2", "gcc", "-march=x86-64-v2", needs=V2, quick=True),
    _c("c x86-64-v3", "gcc", "-march=x86-64-v3", needs=V2 | AVX2),
    _c("c native gcc", "gcc"),
    _c("c native clang", "clang", quick=True),
    Factor("c no compiler", {"CC": "false"}, COMPILED, ("tests/render",), refuse=_compiled),
    Factor("threads 1", {"OMP_NUM_THREADS": "1"}, NUMBERS),
    Factor("threads 2", {"OMP_NUM_THREADS": "2"}, NUMBERS, ("tests/render",), refuse=_one_core),
)


@dataclass
class Outcome:
    """A row of the table."""

    name: str
    tests: int = 0
    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0
    remark: str = ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the factors that are asked for; 1 if a test failed in any."""
    parser = argparse.ArgumentParser(prog="python -m tests.portable", description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", help="factors whose names begin so")
    parser.add_argument("--quick", action="store_true", help="a share of it: two to three minutes on two cores")
    parser.add_argument("--list", action="store_true", help="show the factors and run none")
    args = parser.parse_args(arguments)
    chosen = [f for f in FACTORS if f.name.startswith(args.only or "") and (f.quick or not args.quick)]
    widths = not args.quick and WIDTHS.startswith(args.only or "")
    if not chosen and not widths:
        parser.error(f"no factor's name begins with {args.only!r}: there are {', '.join(f.name for f in FACTORS)}")
    if args.list:
        for factor in chosen:
            words = " ".join(f"{key}={value!r}" for key, value in factor.environment.items())
            print(f"{factor.name:18} {words:34} {' '.join(factor.quick if args.quick else factor.tests)}")
        if widths:
            print(f"{WIDTHS:18} {' '.join(vector_widths.ROWS)}")
        return 0
    machine = this_machine()
    outcomes = []
    for factor in chosen:
        print(f"=== {factor.name}", flush=True)
        outcomes.append(run(factor, machine, factor.quick if args.quick else factor.tests))
    if outcomes:
        print(table(outcomes, machine))
    objections = vector_widths.check() if widths else []
    print("\n".join(objections))
    return int(any(outcome.failed for outcome in outcomes) or bool(objections))


def this_machine() -> Machine:
    """Detect the processor and the defaults without any factor."""
    about: dict[str, str] = {}
    if (path := Path("/proc/cpuinfo")).is_file():
        lines = path.read_text().split("\n\n")[0].splitlines()
        about = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    name = about.get("model name") or platform.processor() or platform.machine()
    return Machine(name, frozenset(about.get("flags", "").split()), probe({}))


def environment(factor: dict[str, str]) -> dict[str, str]:
    """Return the environment of `make test` with the variables of a factor."""
    names = {name for each in FACTORS for name in each.environment}
    plain = {key: value for key, value in os.environ.items() if key not in names}
    return {**plain, "OMP_NUM_THREADS": "1", **factor}


def probe(factor: dict[str, str]) -> dict[str, object]:
    """Return the vector width, compiler and threads in use in an environment; empty if the probe fails."""
    command = [sys.executable, "-c", PROBE]
    told = subprocess.run(
        command, env=environment(factor), cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
    )
    if told.returncode:
        print(told.stderr[-2000:])
        return {}
    return json.loads(told.stdout.splitlines()[-1])


def why_not(factor: Factor, machine: Machine) -> str | None:
    """Return why a factor is not run on this machine: it cannot be had, or it is no change; or None."""
    if missing := sorted(factor.needs - machine.can):
        return f"this processor ({machine.processor}) has no {', '.join(missing)}"
    if factor.compiler and shutil.which(factor.compiler) is None:
        return f"{factor.compiler} is not on this machine"
    used = probe(factor.environment)
    if used and used == machine.usual:
        return "it is what `make test` runs on this machine"
    return factor.refuse(machine, used) if used else None


def run(factor: Factor, machine: Machine, tests: tuple[str, ...]) -> Outcome:
    """Run the tests of a factor, or say why not."""
    outcome, start = Outcome(factor.name), time.perf_counter()
    if reason := why_not(factor, machine):
        outcome.remark = f"not run: {reason}"
        print(outcome.remark)
        return outcome
    processes = max(1, (os.cpu_count() or 1) // int(factor.environment.get("OMP_NUM_THREADS", "1")))
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-rfE", "--tb=short", f"--junitxml={report}", "-p"]
        command += ["no:cacheprovider", f"--numprocesses={min(8, processes)}", "--dist=loadfile"]
        command += ["--runslow", "-m", "not slow"]  # those that take seconds too
        # Missing compiled code or threads are intended here and no warning.
        command += ["-W", "ignore:compiled code", "-k", "not onnx", *drop_nested(tests)]  # ONNX has its own runtime
        status = subprocess.run(command, env=environment(factor.environment), cwd=ROOT, check=False).returncode
        if report.is_file():
            count(outcome, ET.parse(report).getroot())
    if status and not outcome.failed:
        outcome.failed, outcome.remark = 1, f"pytest ended with status {status}"
    outcome.seconds = time.perf_counter() - start
    return outcome


def drop_nested(paths: Sequence[str]) -> list[str]:
    """Return paths once each, without those inside another, which pytest would run twice."""
    unique = list(dict.fromkeys(paths))
    return [path for path in unique if not any(path.startswith(f"{other}/") for other in unique)]


def count(outcome: Outcome, report: ET.Element) -> None:
    """Add up a report of pytest's."""
    for suite in report.iter("testsuite"):
        outcome.tests += int(suite.get("tests", 0))
        outcome.failed += int(suite.get("failures", 0)) + int(suite.get("errors", 0))
        outcome.skipped += int(suite.get("skipped", 0))
    outcome.passed = outcome.tests - outcome.failed - outcome.skipped


def table(outcomes: Sequence[Outcome], machine: Machine) -> str:
    """Return the outcomes as a table in Markdown."""
    rows = [
        f"\n{machine.processor}, {os.cpu_count()} cores; PyTorch's own choice is {machine.usual.get('aten')}\n",
        "| factor | tests | passed | failed | skipped | s | |",
        "|---|--:|--:|--:|--:|--:|---|",
    ]
    rows += [
        f"| {o.name} | {o.tests} | {o.passed} | {o.failed} | {o.skipped} | {o.seconds:.0f} | {o.remark} |"
        for o in outcomes
    ]
    return "\n".join([*rows, f"\n{sum(o.seconds for o in outcomes):.0f} s in all"])


if __name__ == "__main__":
    sys.exit(main())
