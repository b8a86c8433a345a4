"""First use on a machine: the cost profile is scaled by the time that two small scenes take.

Which backend is the fastest depends on the processor. Where nobody has run ``kornia-tidy tune``, the first large scene
that could go to either of two backends is preceded by a measurement of less than half a second, for each kind of
compositing. ``KORNIA_TIDY_TUNE=off`` in the environment forbids it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Collection
from dataclasses import replace

import torch
from torch.utils.data import get_worker_info

from kornia_tidy.render.backend import Backend
from kornia_tidy.render.cost_model import seconds_of
from kornia_tidy.render.cost_profile import CostProfile
from kornia_tidy.render.cost_store import (
    KINDS,
    is_tuning_off,
    measured_profile,
    profile_lock,
    settle_measured,
    settled,
)
from kornia_tidy.render.scene import LayeredScene
from kornia_tidy.render.scene_samples import sample_scene

SMALL = 128 * 128  # px of an image: up to this all backends are fast, and nothing is measured
SECONDS = 0.4  # after which no more rounds are made, for one kind of compositing
LONGEST = 1.0  # s, after which a measurement is given up
ROUNDS = 5
REPEATED = 1.5  # a time counts if another round took at most this many times as long
FINEST = 1e-6  # s, resolution that the clock of a thread must have
SCALED = ", scaled on first use"
SAMPLES = {  # side of the image and of the PSFs
    "gather": ((192, 15), (192, 41)),
    "occlusion": ((128, 15), (128, 41)),
}


def profile_for(compositing: str, pixels: int, able: Collection[str], backends: Collection[Backend]) -> CostProfile:
    """Return the cost profile for a scene, measured now if this is the first use on this machine.

    Scenes that are small, or that cannot be rendered directly, are always priced by the profile that the process
    started with. So nothing that was measured in between changes how a scene is rendered.

    Args:
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        pixels: of one image.
        able: names of the backends that support the scene.
        backends: all of them.
    """
    start = settled()
    if pixels <= SMALL or compositing not in KINDS or compositing in start.measured:
        return start.profile
    if "direct" not in able or len(able) < 2 or _may_not_measure():
        return start.profile
    with profile_lock:
        known = measured_profile(compositing)
        if known is None:
            factors = measure_factors(compositing, backends, start.profile)
            if factors is None:  # the next process may find the machine idle
                settle_measured(compositing, start.profile, keep=False)
                return start.profile
            known = start.profile.scaled(f"{start.profile.name.removesuffix(SCALED)}{SCALED}", factors)
            settle_measured(compositing, known)
    return known


def _may_not_measure() -> bool:
    """Return whether this is no place to measure: forbidden, or one of many workers that load data."""
    return is_tuning_off() or get_worker_info() is not None


def measure_factors(kind: str, backends: Collection[Backend], profile: CostProfile) -> dict[str, float] | None:
    """Return how many times as long as predicted each backend takes, by the name of its rates.

    Args:
        kind: of compositing, a key of :data:`KINDS`.
        backends: to be measured.
        profile: the prediction.

    Returns:
        None if the machine is too busy to tell: a time could not be repeated.
    """
    scenes = [sample_scene(side, psf_size, compositing=kind) for side, psf_size in SAMPLES[kind]]
    # A backend that has to be compiled is compiled by this question.
    cases = [(scene, backend) for scene in scenes for backend in backends if backend.refusal(scene) is None]
    start, threads = time.perf_counter(), torch.get_num_threads()
    times: list[list[float]] = [[] for _ in cases]
    for number in range(ROUNDS + 1):
        for own, (scene, backend) in zip(times, cases, strict=True):
            took = time_rendering(backend, scene)
            if number:  # in the first round caches are cold
                own.append(took)
        if number > 1 and time.perf_counter() - start > SECONDS:
            break
        if time.perf_counter() - start > LONGEST:
            return None
    if any(sorted(own)[1] > REPEATED * min(own) for own in times):
        return None
    ratios: dict[str, list[float]] = {}
    for own, (scene, backend) in zip(times, cases, strict=True):
        work = backend.work(scene)
        ratios.setdefault(work.rates, []).append(min(own) / seconds_of(work, profile, threads))
    return {name: statistics.geometric_mean(own) for name, own in ratios.items()}


def time_rendering(backend: Backend, scene: LayeredScene) -> float:
    """Return the time in seconds of rendering a scene by a backend, its plan included.

    On one thread it is the time of the processor, which does not run while something else does.
    """
    fresh = replace(scene, found={}, grids={})
    alone = torch.get_num_threads() == 1 and time.get_clock_info("thread_time").resolution <= FINEST
    clock = time.thread_time if alone else time.perf_counter
    start = clock()
    with torch.no_grad():
        backend.render(fresh)
    return clock() - start
