from __future__ import annotations

import pytest

from kornia_tidy.render.dispatch import BACKENDS


@pytest.fixture(autouse=True)
def registry():
    """Backends that a test registers are gone after it."""
    before = dict(BACKENDS)
    yield
    BACKENDS.clear()
    BACKENDS.update(before)
