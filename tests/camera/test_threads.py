"""One camera used by several threads: every capture is that of a camera used by one, whatever masks do meanwhile."""

from __future__ import annotations

import copy
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from kornia_tidy import Fidelity, LearnableDwellTimes, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.camera.burst import burst
from kornia_tidy.camera.motion import moving_capture
from kornia_tidy.masks import ZernikeMask
from kornia_tidy.psf import psf_model as module
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.runtime.threads import CaptureNotes, SharedLock
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=8.0)
THREADS = 8
SAMPLES = [
    (torch.rand(1, channels, 24, 24, dtype=dtype), 0.3 + 2 * torch.rand(1, 1, 24, 24, dtype=dtype))
    for channels in (3, 1)
    for dtype in (torch.float32, torch.float64)
]
HEIGHTS = [torch.rand(2, 23, 23) * 5 for _ in range(3)]  # radians


def camera(**options) -> TiDyOptics:
    return TiDyOptics(**{"masks": PixelwiseMask(2), "sensor": None, "fidelity": SMALL, **options})


def in_threads(work: Callable[[int], object], count: int = THREADS) -> list:
    """What all threads return; they begin together, and whatever one raises is raised."""
    start = threading.Barrier(count)

    def begin(index: int) -> object:
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


@torch.no_grad()
def serial(make: Callable[[], TiDyOptics], show: Callable[[TiDyOptics, int], None]) -> list[list[Tensor]]:
    """Captures of each sample with each of the masks, by a camera of its own."""
    found = []
    for variant in range(len(HEIGHTS)):
        optics = make()
        show(optics, variant)
        found.append([optics(*sample) for sample in SAMPLES])
    return found


def show_in_place(optics: TiDyOptics, variant: int) -> None:
    with torch.no_grad():
        optics.masks.phase.copy_(HEIGHTS[variant])


def show_data(optics: TiDyOptics, variant: int) -> None:
    optics.masks.phase.data = HEIGHTS[variant].clone()


def show_other_masks(optics: TiDyOptics, variant: int) -> None:
    masks = PixelwiseMask(2)
    show_in_place(TiDyOptics(masks, fidelity=SMALL), variant)
    optics.masks = masks


def show_state(optics: TiDyOptics, variant: int) -> None:
    optics.load_state_dict({"masks.phase": HEIGHTS[variant]})


WAYS = {"in place": show_in_place, "data": show_data, "other masks": show_other_masks, "state": show_state}


def wrong_captures(count: int, show: Callable[[TiDyOptics, int], None], **options) -> int:
    """Take captures in eight threads while another changes the masks; return how many are not those of some masks."""

    def make() -> TiDyOptics:
        return camera(**options)

    with one_thread_each():
        expected = serial(make, show)
        optics, done = make(), threading.Event()
        show(optics, 0)

        def change() -> None:
            torch.set_num_threads(1)
            variant = 0
            while not done.wait(2e-3):
                variant = (variant + 1) % len(HEIGHTS)
                show(optics, variant)

        def take(index: int) -> int:
            torch.set_num_threads(1)  # of this thread
            wrong = 0
            for i in range(count // THREADS):
                sample = (index + i) % len(SAMPLES)
                coded = optics(*SAMPLES[sample])
                wrong += not any(torch.equal(coded, captures[sample]) for captures in expected)
            return wrong

        changes = threading.Thread(target=change)
        changes.start()
        try:
            return sum(in_threads(take))
        finally:
            done.set()
            changes.join()


class TestThreads(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("way", WAYS)
    def test_feature_hundreds_of_captures_are_those_of_masks_at_one_moment(self, way):
        assert wrong_captures(160, WAYS[way]) == 0

    @pytest.mark.parametrize("compositing", ["scatter", "occlusion"])
    def test_feature_all_states_of_an_exposure_are_of_one_moment(self, compositing):
        """Of a state that is loaded, which is one step. A thread that writes in place may be halted half-way."""
        assert wrong_captures(80, show_state, compositing=compositing) == 0

    @pytest.mark.slow
    @pytest.mark.timeout(1200)
    def test_feature_twenty_thousand_captures(self):
        """Eight threads, RGB and grey, float32 and float64, masks changing between; each way a quarter of them."""
        assert [wrong_captures(5000, show) for show in WAYS.values()] == [0, 0, 0, 0]

    def test_feature_psfs_are_computed_once_for_all_threads(self, monkeypatch):
        built, real = [], module.computed_psf_bank

        def spy(*arguments, **options):
            built.append((arguments[3], arguments[0].dtype, arguments[5]))
            return real(*arguments, **options)

        optics = camera()
        monkeypatch.setattr(module, "computed_psf_bank", spy)
        in_threads(lambda i: [optics(*SAMPLES[(i + j) % 4]) for j in range(8)])
        nodes = [(kind, dtype, psi) for kind, dtype, several in built for psi in several]
        assert len(nodes) == len(set(nodes))

    @torch.no_grad()
    def test_feature_rgb_and_grey_by_turns_do_not_evict_each_other(self, monkeypatch):
        optics = camera()
        for sample in SAMPLES:
            optics(*sample)
        monkeypatch.setattr(module, "computed_psf_bank", lambda *_: pytest.fail("a PSF was computed again"))
        for sample in SAMPLES:
            optics(*sample)

    @torch.no_grad()
    def test_feature_no_more_banks_are_kept_than_that(self):
        optics = camera()
        for wavelength in range(460, 640, 20):
            optics.spectrum = module.Spectrum.monochrome(wavelength * 1e-9)
            optics(*SAMPLES[2])
        (memory,) = optics.psf_model._memories.values()
        assert len(memory._banks) == 4

    def test_feature_the_window_is_measured_once_and_by_all_alike(self, monkeypatch):
        optics = TiDyOptics(PixelwiseMask(2), sensor=None, fidelity="draft")
        expected, fitted, real = optics.window, [], PSFModel._fitted_window
        monkeypatch.setattr(PSFModel, "_fitted_window", lambda self: fitted.append(1) or real(self))
        optics.camera = optics.camera  # to be measured anew
        image, depth = torch.rand(1, 3, 48, 48), torch.ones(1, 1, 48, 48)
        sides = in_threads(lambda i: (optics(image, depth) is None, optics.window)[1])
        assert sides == [expected] * THREADS
        assert len(fitted) == 1

    def test_feature_gradients_in_threads_are_those_of_one(self):
        optics = camera()
        with one_thread_each():
            expected = torch.autograd.grad(optics(*SAMPLES[0]).square().sum(), optics.masks.phase)[0]

            def gradient(_: int) -> Tensor:
                torch.set_num_threads(1)
                with torch.enable_grad():
                    return torch.autograd.grad(optics(*SAMPLES[0]).square().sum(), optics.masks.phase)[0]

            for found in in_threads(gradient):
                assert torch.equal(found, expected)

    def test_feature_each_thread_has_its_noise_from_its_generator(self):
        optics = camera(sensor=SensorNoise(0.01, full_well=1e4))
        with one_thread_each(), torch.no_grad():
            expected = [optics(*SAMPLES[0], generator=torch.Generator().manual_seed(i)) for i in range(THREADS)]
            found = in_threads(lambda i: optics(*SAMPLES[0], generator=torch.Generator().manual_seed(i)))
            assert all(map(torch.equal, found, expected))

    def test_feature_a_warning_is_given_once_and_each_thread_counts_its_own_pixels(self):
        optics = camera()
        image = SAMPLES[0][0]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")

            def clamped(index: int) -> int:
                depth = torch.ones(1, 1, 24, 24)
                depth[..., : index + 1] = 0.1
                optics(image, depth)
                return optics.clamped_pixels

            assert in_threads(clamped) == [24 * (i + 1) for i in range(THREADS)]
        assert len(caught) == 1
        assert "beyond the camera's range" in str(caught[0].message)
        assert optics.clamped_pixels == 0  # of this thread, which took no capture

    def test_feature_bursts_and_copies_while_others_render(self):
        def work(index: int) -> bool:
            torch.set_num_threads(1)
            if index % 2:
                return torch.equal(copy.deepcopy(optics)(*SAMPLES[0]), expected)
            return torch.equal(burst(optics, *SAMPLES[0]), shots)

        optics = camera(color_space="linear")
        with one_thread_each(), torch.no_grad():
            expected, shots = optics(*SAMPLES[0]), burst(optics, *SAMPLES[0])
            assert all(in_threads(work))

    @pytest.mark.parametrize("several", ["burst", "moving scene"])
    def test_feature_all_shots_of_a_burst_are_of_one_moment(self, several, monkeypatch):
        """Masks that change after the first shot are seen by the next burst."""

        def take() -> Tensor:
            image, depth = SAMPLES[0]
            if several == "burst":
                return burst(optics, image, depth)
            return moving_capture(optics, torch.stack([image] * 2, 1), torch.stack([depth] * 2, 1))

        optics, real = camera(), TiDyOptics.irradiance
        with torch.no_grad():
            expected = take()
            monkeypatch.setattr(
                TiDyOptics, "irradiance", lambda self, *given: (real(self, *given), optics.masks.phase.add_(1))[0]
            )
            assert torch.equal(take(), expected)
            assert not torch.equal(take(), expected)

    def test_feature_a_part_of_all_kinds_is_read_at_one_moment(self):
        """Masks and dwell times made of parameters that an optimiser moves in place."""
        optics = camera(masks=ZernikeMask(2), modulator=LearnableDwellTimes((1, 1)))
        now = optics.snapshot(torch.float32)
        with torch.no_grad():
            before = now.psf_bank().psfs
            for parameter in optics.parameters():
                parameter.add_(1)
            assert torch.equal(now.psf_bank().psfs, before)
            assert not torch.equal(optics.psf_bank().psfs, before)


class TestParts(BaseTester):
    def test_feature_a_fork_finds_the_lock_open(self):
        lock, held, done = SharedLock(), threading.Event(), threading.Event()

        def hold() -> None:
            with lock:
                held.set()
                done.wait(60)

        thread = threading.Thread(target=hold)
        thread.start()
        held.wait()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads, from Python 3.12 on
            child = os.fork()
        if child == 0:
            with lock:
                os._exit(7)
        done.set()
        thread.join()
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7

    def test_feature_notes_travel_without_captures(self):
        notes = CaptureNotes()
        notes.of_thread.clamped = torch.tensor(3)
        assert int(notes.clamped) == 3
        assert notes.first_time("a")
        twin = copy.deepcopy(notes)
        assert twin.clamped == 0
        assert twin.is_told("a")
        assert twin.first_time("b")
        assert not notes.is_told("b")
