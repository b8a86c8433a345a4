"""What a reader must know to follow one capture: the functions of ours that it passes, in how many files, how deep."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest
import torch

import kornia_tidy
from kornia_tidy import TiDyOptics
from kornia_tidy.data import dead_leaves
from tests.base import BaseTester
from tests.kernels.operator_tester import needs_compiler

PACKAGE = Path(kornia_tidy.__file__).parent

FUNCTIONS, FILES, DEPTH = 57, 22, 9  # the limits of a remembered capture

Call = tuple[str, str, int]  # file, function, and how many functions of ours are called in one another


def calls_of(work: Callable[[], object]) -> list[Call]:
    """The calls of our functions in their order; comprehensions and lambdas are parts of the function around them.

    An operator of compiled code is followed no further: its docstring says all that a reader of a capture must know.
    """
    found: list[Call] = []
    within: list[str] = []  # files of the functions of ours that are being called

    def watch(frame: FrameType, event: str, _: object) -> None:
        file = Path(frame.f_code.co_filename)
        if event not in {"call", "return"} or not file.is_relative_to(PACKAGE) or frame.f_code.co_name.startswith("<"):
            return
        if event == "return":
            within.pop()
            return
        within.append(file.relative_to(PACKAGE).as_posix())
        if not any(file.startswith("kernels/") for file in within[:-1]):
            found.append((within[-1], frame.f_code.co_qualname, len(within)))

    before = sys.getprofile()
    sys.setprofile(watch)
    try:
        work()
    finally:
        sys.setprofile(before)
    return found


def listed(calls: list[Call]) -> str:
    """The calls as a tree, each once."""
    return "\n" + "\n".join(f"{'  ' * depth}{file} {name}" for file, name, depth in dict.fromkeys(calls))


@pytest.fixture(scope="module", params=["flat", "leaves"])
def calls(request) -> list[Call]:
    """Of the second capture of a scene of 256 x 256 pixels, without gradients, by the camera as it comes."""
    optics, image = TiDyOptics(), torch.rand(1, 3, 256, 256)
    depth = torch.full((1, 1, 256, 256), 0.9)
    if request.param == "leaves":
        leaves = dead_leaves(256, 256, depth_range=(0.3, 10.0), num_leaves=60)
        image, depth = (part[None] for part in leaves)
    with torch.no_grad():
        optics(image, depth)
        return calls_of(lambda: optics(image, depth))


@needs_compiler  # the limits are those of the compiled backend
class TestCallBudget(BaseTester):
    def test_feature_functions(self, calls):
        assert len({call[:2] for call in calls}) <= FUNCTIONS, listed(calls)

    def test_feature_files(self, calls):
        assert len({file for file, _, _ in calls}) <= FILES, listed(calls)

    def test_feature_depth(self, calls):
        assert max(depth for _, _, depth in calls) <= DEPTH, listed(calls)

    def test_feature_every_part_of_the_flow_is_seen(self, calls):
        """Or the limits would be kept by looking away."""
        files = {file for file, _, _ in calls}
        assert {"camera/tidy_optics.py", "psf/psf_cache.py", "sensor/noise.py", "optics/thin_lens.py"} <= files
        assert {"render/scene.py", "render/dispatch.py"} <= files
        assert any(file.startswith("render/backends/") for file in files)
