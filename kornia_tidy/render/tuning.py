"""Fits the cost profile to this machine: measures scenes of many kinds, then solves for the price of each term.

Errors count as fractions of a time, since backends are compared by ratios. Prices are not negative, and terms that the
measurements do not tell apart keep the proportions of the profile that the fit starts from.
"""

from __future__ import annotations

import math
import random
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_tidy.render.cost_model import Work, seconds_of
from kornia_tidy.render.cost_profile import CostProfile, Rates
from kornia_tidy.render.cost_store import KINDS
from kornia_tidy.render.dispatch import BACKENDS, refusal
from kornia_tidy.render.first_use import time_rendering
from kornia_tidy.render.scene_samples import sample_scene

SECONDS = 80.0  # of measuring
ROUNDS = 9  # at most
SLOW = 2.5  # times the fastest backend: slower ones are measured once
LONG = 0.1  # s, from which on a rendering is not repeated at once
PRIOR = 0.05  # how much a term that nothing tells apart is drawn to its proportion, as a fraction of a time
OUTLIER = 0.1  # of a time: errors beyond count by their size, not by its square
ROBUST = 8  # times that weights are found
SWEEPS, CONVERGED = 2000, 1e-6  # over the terms, until prices change by less


@dataclass(frozen=True)
class Case:
    """A scene to be measured, see :func:`kornia_tidy.render.scene_samples.sample_scene`."""

    compositing: str
    side: int
    psf_size: int
    layers: int
    mode: str


@dataclass
class Measurement:
    """The least time that a backend took for a case.

    Args:
        case: the scene.
        backend: name of the backend.
        work: its work for the scene.
        threads: that it was done by.
        seconds: the least time of some rounds.
    """

    case: Case
    backend: str
    work: Work
    threads: int
    seconds: float = math.inf


def tuning_cases() -> list[Case]:
    """Return the scenes of a full measurement: small and large PSFs, few and many layers, sizes up to 640 px."""
    windows, layers = (5, 11, 23, 37, 59, 93, 127), ((1, "nearest"), (4, "nearest"), (5, "linear"), (18, "linear"))
    sides = {"gather": (160, 320, 640), "occlusion": (128, 256)}
    return [
        Case(kind, side, psf_size, count, mode)
        for kind, own in sides.items()
        for number, side in enumerate(own)
        for place, psf_size in enumerate(windows)
        for count, mode in layers[(place + number) % 2 :: 2]
    ]


def measure(
    cases: Sequence[Case],
    seconds: float = SECONDS,
    threads: Iterable[int] | None = None,
    progress: Callable[[float], object] = lambda done: None,
) -> list[Measurement]:
    """Return the least time of each backend for each case, over rounds that take all of them in turn.

    Load from elsewhere makes some rounds slow; the least time is the one that it met least.

    Args:
        cases: from :func:`tuning_cases`.
        seconds: after which nothing more is begun. On a slow machine some cases may then be missing.
        threads: numbers of threads to measure with. Default: one, and as many as torch has.
        progress: called with the fraction of the time that has passed.
    """
    before, start = torch.get_num_threads(), time.perf_counter()
    counts = sorted({1, before}) if threads is None else list(threads)
    order = [(case, count) for case in cases for count in counts]
    found: dict[tuple[Case, int], list[Measurement]] = {}
    shuffled = random.Random(0)  # noqa: S311
    try:
        for _ in range(ROUNDS):
            shuffled.shuffle(order)
            for case, count in order:
                passed = time.perf_counter() - start
                if passed > seconds:
                    return _measured(found)
                progress(min(1.0, passed / seconds))
                torch.set_num_threads(count)
                _measure_once(case, count, found.setdefault((case, count), []))
    finally:
        torch.set_num_threads(before)
    return _measured(found)


def _measured(found: dict[tuple[Case, int], list[Measurement]]) -> list[Measurement]:
    return [one for own in found.values() for one in own]


def _measure_once(case: Case, threads: int, known: list[Measurement]) -> None:
    scene = sample_scene(case.side, case.psf_size, case.layers, case.mode, case.compositing)
    if not known:
        able = [backend for backend in BACKENDS.values() if refusal(backend, scene) is None]
        known += [Measurement(case, backend.name, backend.work(scene), threads) for backend in able]
    fastest = min(one.seconds for one in known)
    for one in known:
        if one.seconds <= SLOW * fastest:
            for _ in range(1 if one.seconds > LONG else 2):  # the first one finds caches cold
                one.seconds = min(one.seconds, time_rendering(BACKENDS[one.backend], scene))


def fit_profile(base: CostProfile, measurements: Sequence[Measurement], name: str) -> CostProfile:
    """Return a profile whose prices fit measurements.

    Args:
        base: where terms that cannot be told apart come from, and what was not measured.
        measurements: from :func:`measure`.
        name: of the profile.
    """
    rates = {}
    for key in (key for keys in KINDS.values() for key in keys):
        own = [one for one in measurements if one.work.rates == key]
        fastest = _fastest(measurements)
        own = [one for one in own if one.seconds <= 2 * SLOW * fastest[one.case, one.threads]] or own
        if own:
            rates[key] = fit_rates(getattr(base, key), own)
    return replace(base, name=name, **rates)


def _fastest(measurements: Iterable[Measurement]) -> dict[tuple[Case, int], float]:
    fastest: dict[tuple[Case, int], float] = {}
    for one in measurements:
        key = one.case, one.threads
        fastest[key] = min(one.seconds, fastest.get(key, math.inf))
    return fastest


def fit_rates(base: Rates, measurements: Sequence[Measurement]) -> Rates:
    """Return the rates of one backend that fit its measurements.

    Threads share s of the work after the first term: s is what the times on several threads over those on one say.
    The prices then minimise the sum of squares of relative errors, large ones weighted down.

    Args:
        base: the rates that the fit starts from.
        measurements: of this backend.
    """
    start = replace(base, shared=_shared(measurements, base.shared))
    shares = np.array([_shares(one, start.shared) for one in measurements])  # of the time, a nanosecond of each price
    guess = np.array(start.nanoseconds)
    scale = 1 / np.median(shares @ guess)
    # A price of zero in `base` starts from zero, in units of 2 % of the time.
    unit = np.where(guess > 0, scale * guess, 0.02 / np.maximum(shares.mean(0), 1e-300))
    prices = _solve(shares * unit, (guess > 0).astype(float)) * unit
    return start.with_nanoseconds(prices.tolist())


def _shares(one: Measurement, shared: float) -> list[float]:
    once, *each = one.work.terms
    factor = 1 - shared + shared / one.threads
    return [1e-9 * term / one.seconds for term in (once, *(factor * term for term in each))]


def _shared(measurements: Sequence[Measurement], default: float) -> float:
    """Return the share of the work that threads divide, from the cases measured on one thread and on several."""
    alone = {one.case: one for one in measurements if one.threads == 1}
    shares = []
    for one in measurements:
        if one.threads > 1 and one.case in alone:
            ratio = one.seconds / alone[one.case].seconds
            shares.append((1 - ratio) / (1 - 1 / one.threads))
    return min(1.0, max(0.0, statistics.median(shares))) if shares else default


def _solve(shares: NDArray[Any], prior: NDArray[Any]) -> NDArray[Any]:
    r"""Return the x >= 0 of least :math:`\sum_i w_i ((A x)_i - 1)^2 + p^2 n |x - x_0|^2`; small w_i for outliers."""
    weights, x, pull = np.ones(len(shares)), prior.copy(), PRIOR**2 * len(shares)
    for _ in range(ROBUST):
        rows = shares * weights[:, None]
        normal = rows.T @ shares + pull * np.eye(len(prior))
        right = rows.sum(0) + pull * prior
        for _ in range(SWEEPS):  # one unknown after the other
            before = x.copy()
            for k in range(len(x)):
                x[k] = max(0.0, x[k] + (right[k] - normal[k] @ x) / normal[k, k])
            if np.abs(x - before).max() <= CONVERGED * x.max():
                break
        errors = np.abs(np.log(np.maximum(shares @ x, 1e-3)))
        weights = OUTLIER / np.maximum(errors, OUTLIER)
    return x


def prediction_errors(profile: CostProfile, measurements: Iterable[Measurement]) -> dict[str, list[float]]:
    """Return the ratios of measured to predicted time, by the name of the backend's rates, ascending."""
    errors: dict[str, list[float]] = {}
    for one in measurements:
        ratio = one.seconds / seconds_of(one.work, profile, one.threads)
        errors.setdefault(one.work.rates, []).append(ratio)
    return {key: sorted(own) for key, own in errors.items()}


def regrets(profile: CostProfile, measurements: Iterable[Measurement]) -> list[float]:
    """Return how many times as long as the fastest backend the one takes that a profile chooses, ascending."""
    cases: dict[tuple[Case, int], list[Measurement]] = {}
    for one in measurements:
        cases.setdefault((one.case, one.threads), []).append(one)
    chosen = [min(own, key=lambda one: seconds_of(one.work, profile, one.threads)) for own in cases.values()]
    return sorted(
        one.seconds / min(other.seconds for other in own) for one, own in zip(chosen, cases.values(), strict=True)
    )
