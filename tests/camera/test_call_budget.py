"""What a reader must know to follow one capture: the functions of ours that it passes, in how many files, how deep."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest
import torch

import kornia_tidy
from kornia_tidy import NoMask, ThinLensCamera, TiDyOptics
from kornia_tidy.data import dead_leaves
from tests.base import BaseTester
from tests.kernels.operator_tester import needs_compiler

PACKAGE = Path(kornia_tidy.__file__).parent

# Functions, files and depth at most. Counted are what a reader of such a capture meets, the backward pass too.
LIMITS = {
    "flat": (40, 16, 8),
    "leaves": (40, 16, 8),
    "gradient": (84, 26, 11),
    "new scene": (72, 24, 12),
    "wide lens": (64, 23, 12),
}

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


@pytest.fixture(scope="module", params=LIMITS)
def counted(request) -> tuple[str, list[Call]]:
    """The second capture of a scene of 256 x 256 pixels by the camera as it comes, or by an f/2 lens without a mask."""
    optics, image = TiDyOptics(), torch.rand(1, 3, 256, 256)
    depth = torch.full((1, 1, 256, 256), 0.9)
    leaves = dead_leaves(256, 256, depth_range=(0.3, 10.0), num_leaves=60)
    if request.param == "wide lens":
        lens = ThinLensCamera(f_number=2.8, focus_distance=2.0, pixel_pitch=6e-6)
        optics, leaves = TiDyOptics(NoMask(), lens), (leaves[0], leaves[1].clamp(min=1.5))
    if request.param in {"leaves", "wide lens"}:
        image, depth = (part[None] for part in leaves)
    if request.param == "gradient":
        optics(image, depth).sum().backward()
        return request.param, calls_of(lambda: optics(image, depth).sum().backward())
    with torch.no_grad():
        optics(image, depth)
        if request.param == "new scene":
            depth = torch.linspace(0.35, 9.0, 256).expand(1, 1, 256, 256)
            copy.deepcopy(optics)(image, depth)  # the matrices of PSFs follow from the lens, and are known from then on
        return request.param, calls_of(lambda: optics(image, depth))


@pytest.fixture
def calls(counted) -> list[Call]:
    return counted[1]


@pytest.fixture
def limits(counted) -> tuple[int, int, int]:
    return LIMITS[counted[0]]


@needs_compiler  # the limits are those of the compiled backend
class TestCallBudget(BaseTester):
    def test_feature_functions(self, calls, limits):
        assert len({call[:2] for call in calls}) <= limits[0], listed(calls)

    def test_feature_files(self, calls, limits):
        assert len({file for file, _, _ in calls}) <= limits[1], listed(calls)

    def test_feature_depth(self, calls, limits):
        assert max(depth for _, _, depth in calls) <= limits[2], listed(calls)

    def test_feature_every_part_of_the_flow_is_seen(self, calls):
        """Or the limits would be kept by looking away."""
        files = {file for file, _, _ in calls}
        assert {"camera/tidy_optics.py", "psf/psf_cache.py", "sensor/sensor.py", "optics/thin_lens.py"} <= files
        wide = "psf/wide_psfs.py" in files  # such a lens is convolved on coarse grids
        assert ({"render/coarse_gather.py"} if wide else {"render/scene.py", "render/dispatch.py"}) <= files
        assert wide or any(file.startswith("render/backends/") for file in files)
