"""Memory of a data loader that takes pictures: flat over a thousand samples, without workers and in workers."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.augmentation.loader_memory import COUNT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="reads the memory of a process from Linux' /proc"),
]
LOADERS = [(0, "none"), (2, "fork"), (2, "spawn")]


def growth(workers: int, context: str, keep: bool) -> float:
    """Return the samples by which a process grew, for each that it loaded meanwhile."""
    run = [sys.executable, "-m", "tests.augmentation.loader_memory", str(workers), context, str(int(keep))]
    done = subprocess.run(run, capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stderr
    return float(done.stdout) / (COUNT * 5 / 9 / max(workers, 1))  # from the first third to the last ninth


@pytest.mark.parametrize(("workers", "context"), LOADERS)
def test_feature_no_leak_over_a_thousand_samples(workers, context):
    """Less than a fifth of a sample for each: a depth map alone that is kept would be a quarter."""
    assert growth(workers, context, keep=False) < 0.2


@pytest.mark.parametrize(("workers", "context"), LOADERS[:2])
def test_feature_the_measurement_sees_a_leak(workers, context):
    assert growth(workers, context, keep=True) > 0.9
