"""First use on a machine: the cost profile is scaled by the time that two small scenes take.

Which backend is the fastest depends on the processor. Where nobody has run ``kornia-tidy tune``, the first large scene
that could go to either of two backends is preceded by a measurement of less than half a second, for each kind of
compositing. ``KORNIA_TIDY_TUNE=off`` in the environment forbids it.
"""

from __future__ import annotations

import math
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
SECONDS = 0.4  # that a measurement may take, for one kind of compositing, beside the first rendering of each scene
ROUNDS = 5
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
            known = start.profile.scaled(f"{start.profile.name.removesuffix(SCALED)}{SCALED}", factors)
            settle_measured(compositing, known)
    return known


def _may_not_measure() -> bool:
    """Return whether this is no place to measure: forbidden, or one of many workers that load data."""
    return is_tuning_off() or get_worker_info() is not None


def measure_factors(kind: str, backends: Collection[Backend], profile: CostProfile) -> dict[str, float]:
    """Return how many times as long as predicted each backend takes, by the name of its rates.

    Args:
        kind: of compositing, a key of :data:`KINDS`.
        backends: to be measured.
        profile: the prediction.
    """
    threads = torch.get_num_threads()
    ratios: dict[str, list[float]] = {name: [] for name in KINDS[kind]}
    deadline = time.perf_counter() + SECONDS
    scenes = [sample_scene(side, psf_size, compositing=kind) for side, psf_size in SAMPLES[kind]]
    times: dict[tuple[int, str], float] = {}
    for round_ in range(ROUNDS + 1):  # the first one is not counted
        for number, scene in enumerate(scenes):
            for backend in backends:
                if round_ > 1 and time.perf_counter() > deadline:
                    break
                took = time_rendering(backend, scene)
                if round_:
                    times[number, backend.name] = min(took, times.get((number, backend.name), math.inf))
    for number, scene in enumerate(scenes):
        for backend in backends:
            work = backend.work(scene)
            ratios[work.rates].append(times[number, backend.name] / seconds_of(work, profile, threads))
    return {name: math.exp(sum(map(math.log, own)) / len(own)) for name, own in ratios.items() if own}


def time_rendering(backend: Backend, scene: LayeredScene) -> float:
    """Return the seconds that a backend takes to render a scene whose labels are not known yet."""
    fresh = replace(scene, found={})
    start = time.perf_counter()
    with torch.no_grad():
        backend.render(fresh)
    return time.perf_counter() - start
