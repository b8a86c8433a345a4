"""`kornia-tidy tune`: measures how fast the renderer's backends are here, so that the fastest one is chosen."""

from __future__ import annotations

import argparse
import statistics
import sys
from typing import Any

import torch
from tqdm import tqdm

from kornia_tidy.commands.report import Stages, tell
from kornia_tidy.render.cost_store import (
    KINDS,
    StoredProfile,
    forget_profile,
    profile_path,
    read_profile,
    shipped_profile,
    write_profile,
)
from kornia_tidy.render.tuning import SECONDS, fit_profile, measure, prediction_errors, regrets, tuning_cases

DESCRIPTION = """\
Measure how fast each backend of the renderer is on this machine, and keep the result
in the user's cache. Gather and occlusion can be rendered by direct convolution, by
tiles or by transforms of the whole image. All give the same image up to rounding;
which one is the fastest depends on the scene, the processor and the threads. The
renderer chooses by a cost model, whose constants are measured here. It takes about a
minute and a half and wants an idle machine.

Without it, the first large scene is preceded by a measurement of half a second, which
scales constants that were measured elsewhere. KORNIA_TIDY_TUNE=off in the environment
forbids that, and to read what was measured.

A kept profile holds for one processor, number of threads (OMP_NUM_THREADS), version of
torch and C compiler. Images are the same up to the last digits with any profile.
"""

EPILOG = """\
examples:
  Measure with as many threads as torch takes, then with one, for data loaders:
    kornia-tidy tune
    OMP_NUM_THREADS=1 kornia-tidy tune

  What is in use, and back to what is shipped:
    kornia-tidy tune --show
    kornia-tidy tune --forget

In Python, which backend a scene takes and why:
  print(optics.explain(image, depth))
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "tune",
        help="measure this machine, so that the fastest backend renders",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--show", action="store_true", help="print the profile in use, and measure nothing")
    other.add_argument("--forget", action="store_true", help="remove the profile that is kept, and measure nothing")


def run(args: argparse.Namespace) -> None:
    """Show, forget, or measure."""
    threads = torch.get_num_threads()
    if args.show:
        show(threads)
    elif args.forget:
        removed = forget_profile(threads)
        tell("removed", str(removed) if removed else f"nothing: no profile is kept for {threads} threads")
    else:
        tune(threads)


def tune(threads: int, seconds: float = SECONDS) -> None:
    """Measure, fit, tell how well the predictions are now, and keep the profile."""
    path, base = profile_path(threads), shipped_profile()  # an unusable folder is an error before any work
    stages = Stages()
    with stages("measured"), _progress() as bar:
        measurements = measure(tuning_cases(), seconds, progress=lambda done: bar.update(done - bar.n))
    with stages("fitted"):
        profile = fit_profile(base, measurements, f"tuned here, {threads} threads")
    for key in prediction_errors(base, measurements):
        before, after = (_errors(prediction_errors(p, measurements)[key]) for p in (base, profile))
        tell("time", f"{key.replace('_', ' by '):24} over predicted: {before} as shipped, {after} tuned")
    before, after = (_regret(regrets(p, measurements)) for p in (base, profile))
    tell("choice", f"{before} as shipped")
    tell("choice", f"{after} tuned")
    if statistics.fmean(regrets(profile, measurements)) > statistics.fmean(regrets(base, measurements)):
        raise ValueError(
            "the tuned profile chooses worse than the shipped one, so it is not kept: is the machine idle?"
        )
    write_profile(threads, StoredProfile(profile, tuple(KINDS)))
    tell("kept", str(path))
    tell("took", stages.summary())


def show(threads: int) -> None:
    """Print the profile that a new process would start from."""
    stored = read_profile(threads)
    tell("profile", in_words(stored, threads))
    profile = stored.profile if stored else shipped_profile()
    for key, rates in profile.as_json().items():
        if isinstance(rates, dict):
            numbers = ", ".join(f"{name} {number:.4g}" for name, number in rates.items())
            tell("ns", f"{key}: {numbers}")


def in_words(stored: StoredProfile | None, threads: int) -> str:
    """Return the name of a profile and where it comes from."""
    if stored is None:
        return f"{shipped_profile().name} as shipped, for {threads} threads (see `kornia-tidy tune`)"
    kinds = " and ".join(stored.measured) or "nothing"
    return f"{stored.profile.name}, measured for {kinds} on {threads} threads: {profile_path(threads)}"


def _errors(ratios: list[float]) -> str:
    """Return the median and the middle 80 %."""
    ends = (ratios[round(share * (len(ratios) - 1))] for share in (0.1, 0.9))
    return f"{statistics.median(ratios):.2f} ({' to '.join(f'{end:.2f}' for end in ends)})"


def _regret(ratios: list[float]) -> str:
    within = [sum(ratio <= bound for ratio in ratios) / len(ratios) for bound in (1.15, 1.5)]
    return (
        f"{within[0]:.0%} of {len(ratios)} cases within 1.15 of the fastest backend, {within[1]:.0%} within 1.5, at "
        f"most {ratios[-1]:.2f}"
    )


def _progress() -> tqdm:
    form = "tune: {percentage:3.0f}%|{bar}| {elapsed}"
    return tqdm(total=1.0, file=sys.stderr, leave=False, disable=None, bar_format=form)
