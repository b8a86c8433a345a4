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


class CallRecorder:
    """Writes ``{test: [seconds, [file:function, ...]]}`` of the tests that passed.

    Args:
        root: of the checkout.
        path: JSON file, written at the end.
    """

    def __init__(self, root: Path, path: Path) -> None:
        self._prefix = f"{root / 'kornia_tidy'}/"
        self._skip = len(f"{root}/")
        self._path = path
        self._called: set[str] = set()
        self._tests: dict[str, tuple[float, list[str]]] = {}

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
            self._tests[item.nodeid] = (time.perf_counter() - begin, sorted(self._called))

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Iterator[None]:
        """Leave out tests that are skipped or that fail without any mutation."""
        outcome = yield
        if not outcome.get_result().passed:  # type: ignore[attr-defined]
            item.was_left_out = True  # type: ignore[attr-defined]

    def pytest_sessionfinish(self) -> None:
        """Write the file."""
        self._path.write_text(json.dumps(self._tests))
