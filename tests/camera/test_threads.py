"""One camera used by several threads while its masks stand still, and copies of it whose masks change meanwhile."""

from __future__ import annotations

import copy
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain

import pytest
import torch
from torch import Tensor

from kornia_tidy import Fidelity, NoMask, PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.psf import exact
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=8.0)
THREADS = 8
SAMPLES = [
    (torch.rand(1, channels, 24, 24, dtype=dtype), 0.3 + 2 * torch.rand(1, 1, 24, 24, dtype=dtype))
    for channels in (3, 1)
    for dtype in (torch.float32, torch.float64)
]
LARGE = torch.rand(1, 3, 320, 40), 0.3 + 2 * torch.rand(1, 1, 320, 40)  # in bands where memory is short
FAST = ThinLensCamera(f_number=5.6, focus_distance=0.8, depth_range=(0.29, 3.0))  # whose blur is wide
CAMERAS: dict[str, Callable[[], TiDyOptics]] = {
    "gather": lambda: camera(compositing="gather"),
    "scatter": lambda: camera(compositing="scatter"),
    "occlusion": lambda: camera(compositing="occlusion"),
    "window to be measured": lambda: camera(fidelity="draft"),
    "bands": lambda: camera(memory_budget=1),
    "wide blur": lambda: camera(masks=NoMask(), camera=FAST, fidelity="draft"),
}


def camera(**options) -> TiDyOptics:
    return TiDyOptics(**{"masks": PixelwiseMask(2, initial="noise"), "sensor": None, "fidelity": SMALL, **options})


def in_threads(work: Callable[[int], object], count: int = THREADS) -> list:
    """What all threads return; they begin together, and whatever one raises is raised."""
    start = threading.Barrier(count)

    def begin(index: int) -> object:
        torch.set_num_threads(1)  # of this thread
        start.wait()
        with torch.no_grad():
            return work(index)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(begin, range(count)))


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Kernels of one thread, as sums over pixels depend on how many share them: new threads have OpenMP's default."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class TestThreads(BaseTester):
    @pytest.mark.parametrize(
        "kind", [pytest.param(kind, marks=[pytest.mark.takes_seconds] * (kind == "wide blur")) for kind in CAMERAS]
    )
    def test_feature_captures_are_those_of_a_camera_used_by_one(self, kind):
        """Of a camera that no thread has used before: window, pupil and PSFs are found by all of them at once."""
        samples = {"bands": [LARGE], "wide blur": SAMPLES[:1]}.get(kind, SAMPLES)
        with one_thread_each(), torch.no_grad():
            optics = CAMERAS[kind]()
            expected = [copy.deepcopy(optics)(*sample) for sample in samples]

            def take(index: int) -> int:
                order = [(index + i) % len(samples) for i in range(2 * len(samples))]
                return sum(not torch.equal(optics(*samples[i]), expected[i]) for i in order)

            count = 2 if kind == "wide blur" else THREADS
            assert in_threads(take, count) == [0] * count

    def test_feature_lenses_that_evict_what_others_remember(self, monkeypatch):
        """Kernels of PSFs are remembered for the process: here so few that each lens drops those of the others."""
        monkeypatch.setattr(exact.MEMORY, "most_bytes", 1 << 16)
        with one_thread_each(), torch.no_grad():
            lenses = [ThinLensCamera(focus_distance=0.5 + 0.1 * i) for i in range(THREADS)]

            def captures(index: int) -> list[Tensor]:
                optics, found = camera(masks=PixelwiseMask(1, initial="flat"), camera=lenses[index]), []
                optics.check_inputs = False
                for _ in range(4):
                    optics.masks.phase[:, :4].add_(1)
                    found.append(optics(*SAMPLES[0]))
                return found

            expected = [captures(index) for index in range(THREADS)]
            for one, other in zip(chain(*in_threads(captures)), chain(*expected), strict=True):
                assert torch.equal(one, other)

    def test_feature_gradients_in_threads_are_those_of_one(self):
        optics = camera()
        with one_thread_each():
            expected = torch.autograd.grad(optics(*SAMPLES[0]).square().sum(), optics.masks.phase)[0]

            def gradient(_: int) -> Tensor:
                with torch.enable_grad():
                    return torch.autograd.grad(optics(*SAMPLES[0]).square().sum(), optics.masks.phase)[0]

            for found in in_threads(gradient):
                assert torch.equal(found, expected)


class TestNotes(BaseTester):
    def test_feature_a_camera_counts_clamped_pixels_and_warns_once_and_its_copy_by_itself(self):
        optics, depth = camera(), torch.ones(1, 1, 24, 24)
        depth[..., :3] = 0.1
        with pytest.warns(UserWarning, match="beyond the camera's range"):
            optics(SAMPLES[0][0], depth)
        twin = copy.deepcopy(optics)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            twin(SAMPLES[0][0], torch.ones(1, 1, 24, 24))
            optics.with_fidelity("draft")(SAMPLES[0][0], depth)
        assert (optics.clamped_pixels, twin.clamped_pixels) == (72, 0)
