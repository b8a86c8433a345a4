"""One mutant before the tests: which of them, in what order, and a fork of this process that runs them under limits."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import pytest

from tests.code_mutants.calls import Calls
from tests.code_mutants.mutants import Mutant

SECONDS = 60  # processor time for the tests of a mutant; longer means a hang
PATIENCE = 5  # seconds by the clock for each of the processor: other work may slow it
ONE_TEST = 60  # seconds by the clock for one test
TESTS = 20.0  # seconds of tests, as they take without a mutation, that a mutant is shown to
SETTLED = 5.0  # seconds of tests in the first run, which catches most mutants
MEMORY = 9 << 30  # bytes of address space
REWRITTEN = "ignore:Module already imported:pytest.PytestAssertRewriteWarning"  # before the fork
OPTIONS = ("-q", "-n0", "-p", "no:cacheprovider", "--tb=line", "--no-header", "-W", REWRITTEN)


@dataclass(frozen=True)
class Trial:
    """What became of a mutant.

    Args:
        outcome: ``"caught"``, ``"survived"``, ``"uncalled"`` (no test calls it) or ``"no code"`` (it does not compile).
        by: the test that noticed, or ``"time"`` or ``"crash"``.
        tests: how many tests it was shown to at most.
        left: how many more call it.
        seconds: by the clock.
    """

    outcome: str
    by: str
    tests: int
    left: int
    seconds: float


def chosen_tests(mutant: Mutant, calls: Calls, root: Path) -> list[str]:
    """Return the tests that may notice a mutant, the likeliest first: those of its file, its package, then others.

    They call the mutated function; outside functions, any function of the file; in C, operators that load the source.
    All tests of its own test file come too. Shorter ones come first.
    """
    path = Path(mutant.path)
    stem = path.stem
    if path.suffix == ".py":
        files = [mutant.path]
    else:
        ops = [p.relative_to(root) for p in (root / path.parent).glob("*.py")]
        files = [p.as_posix() for p in ops if f'"{path.name}"' in (root / p).read_text() or path.suffix == ".h"]
    names = {f"{file}:{mutant.function}" for file in files}
    own = re.compile(rf"tests/.*test_{stem}\.py::|{re.escape(mutant.path)}::")
    package = re.compile(rf"(tests|kornia_tidy)/{re.escape(path.parts[1])}/")
    ranked = []
    for test, (seconds, called) in calls.items():
        calling = [c for c in called if (c in names if mutant.function else c.rpartition(":")[0] in files)]
        inside = [c for c in calling if not c.endswith("<module>")]
        if inside or own.match(test):
            rank = 0 if inside and own.match(test) else 1 if inside and package.match(test) else 2 if inside else 3
            ranked.append((rank, seconds, test))
    return [test for _, _, test in sorted(ranked)]


def within(tests: Sequence[str], calls: Calls, seconds: float) -> int:
    """Return how many of the tests take no longer than this together; at least one."""
    total = 0.0
    for i, test in enumerate(tests):
        total += calls[test][0]
        if total > seconds and i:
            return i
    return len(tests)


def try_mutant(mutant: Mutant, tests: Sequence[str], calls: Calls, root: Path, log: Path) -> Trial:
    """Put a mutant into the checkout, run tests in a fork of this process, and mend the checkout.

    Args:
        mutant: the fault.
        tests: see :func:`chosen_tests`.
        calls: functions and duration of each test.
        root: the checkout; its file is changed meanwhile.
        log: file for the tests' output.
    """
    begin = time.perf_counter()
    path = root / mutant.path
    source = path.read_bytes()
    shown = within(tests, calls, TESTS)
    try:
        path.write_bytes(mutant.apply(source))
        if not compiles(path):
            return Trial("no code", "", 0, 0, 0.0)
        outcome, by = (
            _in_fork(tests[:shown], within(tests[:shown], calls, SETTLED), root, log) if tests else ("uncalled", "")
        )
    finally:
        path.write_bytes(source)
    return Trial(outcome, by, shown, len(tests) - shown, time.perf_counter() - begin)


def compiles(path: Path) -> bool:
    """Return whether a source is one."""
    if path.suffix == ".py":
        try:
            compile(path.read_bytes(), str(path), "exec")
        except SyntaxError:
            return False
        return True
    sources = path.parent.glob("*.c") if path.suffix == ".h" else [path]
    command = [
        "cc",
        "-fsyntax-only",
        "-Werror=implicit-function-declaration",
        "-std=gnu11",
        "-march=native",
        "-DREAL=float",
    ]
    return all(subprocess.run([*command, str(s)], capture_output=True, check=False).returncode == 0 for s in sources)


def _in_fork(tests: Sequence[str], first: int, root: Path, log: Path) -> tuple[str, str]:
    process = os.fork()
    if process == 0:
        _child(tests, first, root, log)
    deadline = time.monotonic() + PATIENCE * SECONDS
    while not (ended := os.waitpid(process, os.WNOHANG))[0]:
        if time.monotonic() > deadline:
            os.killpg(process, signal.SIGKILL)
            ended = os.waitpid(process, 0)
            return "caught", "time"
        time.sleep(0.01)
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)  # its children
    code = os.waitstatus_to_exitcode(ended[1])
    if code == 0:
        return "survived", ""
    if code == -signal.SIGXCPU:
        return "caught", "time"
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", log.read_text(errors="replace"), re.MULTILINE)
    return "caught", failed[0] if failed else "crash" if code < 0 else f"exit status {code}"


def _child(tests: Sequence[str], first: int, root: Path, log: Path) -> NoReturn:
    """Run the tests and leave; nothing of this process is unwound."""
    code = 99
    try:
        os.setpgid(0, 0)
        output = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
        enter(root)
        sys.dont_write_bytecode = True
        for part in (tests[:first], tests[first:]):
            if part:
                code = run_tests(part)
            if code:
                break
        sys.stdout.flush()
    finally:
        os._exit(code)


def run_tests(tests: Sequence[str]) -> int:
    """Run tests in this order, to the first that fails; return pytest's exit status."""
    files = list(dict.fromkeys(test.partition("::")[0] for test in tests))
    return int(pytest.main([*OPTIONS, "-x", "-rfE", f"--timeout={ONE_TEST}", *files], plugins=[_Chosen(tests)]))


def enter(root: Path) -> None:
    """Let this process, and those that it starts, import package and tests from a checkout."""
    for name in [name for name in sys.modules if name == "tests" or name.startswith("tests.")]:
        del sys.modules[name]
    sys.modules["__main__"] = ModuleType("__main__")  # processes that are spawned import their parent's
    sys.path.insert(0, str(root))
    os.environ["PYTHONPATH"] = str(root)
    os.chdir(root)


class _Chosen:
    """Leaves the tests that were chosen, in their order."""

    def __init__(self, tests: Sequence[str]) -> None:
        self._place = {test: i for i, test in enumerate(tests)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted((i for i in items if i.nodeid in self._place), key=lambda i: self._place[i.nodeid])
