"""What every benchmark shares: the size of the picture, and the facts without which a time means nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from kornia_tidy.design.tradeoff.costs import synchronize

SIZE_VARIABLE = "KORNIA_TIDY_BENCH_SIZE"


@pytest.fixture
def size() -> int:
    """Side of the picture in pixels: tiny, so that every benchmark runs once in seconds, unless told otherwise."""
    return int(os.environ.get(SIZE_VARIABLE, "64"))


@pytest.fixture
def bench(benchmark, device, size, request) -> Callable[..., None]:
    """Time an action on the device, and write down what it worked on. What it returns must be finite.

    Facts: ``masks`` K, ``layers`` D, ``window`` P, ``wavelengths`` W, ``pupil`` (samples of the pupil along a side);
    0 where there are none. The picture has ``size`` x ``size`` pixels, 0 where there is none.
    """

    def run(action: Callable[[], Any], **facts: int) -> None:
        def timed() -> Any:
            result = action()
            synchronize(device)
            return result

        benchmark.group = request.node.path.stem.removeprefix("test_")
        none = {"masks": 0, "layers": 0, "window": 0, "wavelengths": 0, "pupil": 0}
        benchmark.extra_info |= {"size": size, **none, **facts, "device": str(device)}
        benchmark.extra_info["threads"] = torch.get_num_threads()
        assert all(bool(tensor.isfinite().all()) for tensor in _tensors(benchmark(timed)))

    return run


def _tensors(result: Any) -> Iterator[torch.Tensor]:
    """Yield the tensors of a result, of tuples and mappings of them, too."""
    if isinstance(result, torch.Tensor):
        yield result
    elif isinstance(result, (tuple, list, dict)):
        for part in result.values() if isinstance(result, dict) else result:
            yield from _tensors(part)


@pytest.fixture
def scene(size, device) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture and a depth map that holds every depth of the default camera."""
    defocus = torch.linspace(-20, 20, size * size, device=device).view(1, 1, size, size)
    depth = 1 / (1 / 0.595 + defocus * 530e-9 / (torch.pi * 1.4175e-3**2))
    return torch.rand(1, 3, size, size, device=device), depth
