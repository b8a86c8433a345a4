"""Which functions of the package each test calls, and how long it takes: a plugin of pytest that records it.

Only tests that call a function can notice a fault in it, so a mutant meets only those.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest

Calls = dict[str, tuple[float, list[str]]]  # of each test: seconds, and the functions that it calls


class CallRecorder:
    """Writes a line ``[test, [seconds, [file:function, ...]]]`` for each test that passes.

    Args:
        root: of the checkout.
        path: file of lines of JSON, which gets this name at the end. A run that was cut short goes on where it stopped.
    """

    def __init__(self, root: Path, path: Path) -> None:
        self._prefix = f"{root / 'kornia_tidy'}/"
        self._skip = len(f"{root}/")
        self._path = path
        self._part = path.with_suffix(".part")
        self._called: set[str] = set()
        self._known = read_calls(self._part) if self._part.exists() else {}

    def _watch(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(self._prefix):
            self._called.add(f"{code.co_filename[self._skip :]}:{code.co_qualname}")

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch a test with its fixtures."""
        self._called = set()
        begin = time.perf_counter()
        sys.settrace(self._watch)
        threading.settrace(self._watch)
        yield
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]
        if not getattr(item, "was_left_out", False):
            with self._part.open("a") as file:
                file.write(json.dumps((item.nodeid, (time.perf_counter() - begin, sorted(self._called)))) + "\n")

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Iterator[None]:
        """Leave out tests that are skipped or that fail without any mutation."""
        outcome = yield
        if not outcome.get_result().passed:  # type: ignore[attr-defined]
            item.was_left_out = True  # type: ignore[attr-defined]

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out tests that an earlier run recorded."""
        items[:] = [item for item in items if item.nodeid not in self._known]

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        """Name the file, unless the run was cut short."""
        if exitstatus in {pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED}:
            self._part.rename(self._path)


def read_calls(path: Path) -> Calls:
    """Return what a :class:`CallRecorder` wrote."""
    return dict(json.loads(line) for line in path.read_text().splitlines())
