"""Verdicts: measured gains against their targets, on half B of the real scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from kornia_tidy.design.candidates import FLAT
from kornia_tidy.design.design_report import DATA
from kornia_tidy.files import read_json
from kornia_tidy.sensor import electrons_at
from tests.benchmarks.results.captures import FIXED, PHYSICAL, REFERENCE_F_NUMBER
from tests.benchmarks.results.measure import BEST_RAMP, NO_CAMERA, NO_NOISE
from tests.benchmarks.results.restorations import BY_DEPTH, ENSEMBLE, NETWORK
from tests.benchmarks.results.scores import SURE
from tests.benchmarks.results.table import Difference, Key, Results

REAL = "real"
FIVE, ONE, JOINT = "edof-5", "edof-1", "joint-uncertain"
GAINS = {"0.002": 1.5, "0.01": 2.7, "0.03": 3.5}  # dB of five masks' network over their best closed form
SHARE_AHEAD = 0.95  # of scenes and noises
SSIM_GAIN, CHROMA_GAIN, MASKS_GAIN = 0.04, 1.5, 1.2
WRONG_NOISE_LOSS = 0.3  # dB
CODED_GAINS = {"57000e": 1.5, "10000e": 0.5}  # dB of coded over flat, both with networks
TEXTURED_GAIN = 0.35  # of the RMSE of the best ramp
SUREST_ERROR = 0.10  # of the range
LAYERED_GAIN = 2.0  # dB of the joint network over the inversion by its own depth


class Verdict(NamedTuple):
    """A target with the measurement."""

    claim: str
    measured: str
    target: str
    met: bool | None
    """None where it was not measured, or there is no target."""


def recommendations(folders: Sequence[Path]) -> dict[str, str]:
    """Return by noise whether the designs in folders of ``kornia-tidy design`` recommend ``"coded"`` or ``"flat"``.

    Raises:
        ValueError: if a design is for another amount of light than the benchmark's.
    """
    found = {}
    for folder in folders:
        report = read_json(folder / DATA)
        task = report["task"]
        noise = f"{electrons_at(REFERENCE_F_NUMBER, task['electrons'], task['reference_f_number']):.0f}e"
        if noise not in PHYSICAL:
            raise ValueError(
                f"{folder} is a design for {noise[:-1]} electrons at f/{REFERENCE_F_NUMBER:g}, not measured"
            )
        found[noise] = "flat" if report["recommended"]["start"] == FLAT else "coded"
    return found


def verdicts(results: Results, recommended: Mapping[str, str] | None = None) -> list[Verdict]:
    """Return the targets in their order.

    Args:
        results: the measured scores.
        recommended: see :func:`recommendations`.
    """
    return [
        *_networks(results),
        *_stray_light(results),
        *_wrong_noise(results),
        *_coded_against_flat(results),
        *_recommended(results, recommended or {}),
        *_joint(results),
    ]


def _networks(results: Results) -> Iterator[Verdict]:
    """Five masks: network against the best closed form of the same captures."""
    yield from _over_closed_form(results, NETWORK)
    if any(Key(REAL, noise, FIVE, ENSEMBLE) in results.rows for noise in FIXED):
        yield from _over_closed_form(results, ENSEMBLE)
    both = [Key(REAL, FIXED[0], system, NETWORK) for system in (FIVE, ONE)]
    gain = results.difference(both[0], both[1]) if all(key in results.rows for key in both) else None
    yield _at_least(f"noise {FIXED[0]}: network of {FIVE} over that of {ONE}", gain, MASKS_GAIN)


def _over_closed_form(results: Results, restoration: str) -> Iterator[Verdict]:
    """A kind of network of five masks against their best closed form."""
    pairs = {}
    for noise in FIXED:
        closed = results.best(results.keys(REAL, noise, system=FIVE, network=False))
        ours = Key(REAL, noise, FIVE, restoration)
        if closed is not None and ours in results.rows:
            pairs[noise] = ours, closed
    for noise, target in GAINS.items():
        name = pairs[noise][1].restoration if noise in pairs else "its best closed form"
        gain = results.difference(*pairs[noise]) if noise in pairs else None
        yield _at_least(f"{FIVE}, noise {noise}: {restoration} over {name}", gain, target)
    gains = [results.difference(*pair) for pair in pairs.values()]
    count, ahead = sum(gain.pairs for gain in gains), sum(gain.ahead for gain in gains)
    yield Verdict(
        f"{FIVE}: {restoration} ahead of its best closed form",
        f"{ahead} of {count} scenes and noises",
        f"{100 * SHARE_AHEAD:.0f} of 100",
        ahead >= SHARE_AHEAD * count if len(gains) == len(FIXED) else None,
    )
    for score, name, target in (("ssim", "SSIM", SSIM_GAIN), ("chroma", "chroma PSNR", CHROMA_GAIN)):
        for noise in FIXED:
            gain = results.difference(*pairs[noise], score) if noise in pairs else None
            yield _at_least(
                f"{FIVE}, noise {noise}: {name} of the {restoration} over its best closed form", gain, target
            )


def _stray_light(results: Results) -> Iterator[Verdict]:
    """Gain of captures with all their light over those in the small window of older training, where it was measured."""
    closed = results.best(results.keys(REAL, FIXED[0], system=FIVE, network=False))
    for row in (Key(REAL, FIXED[0], FIVE, NETWORK), closed):
        if row is not None:
            small = row._replace(system=f"{FIVE} as trained")
            if small in results.rows:
                claim = f"{FIVE}, noise {FIXED[0]}: {row.restoration}, all light over the window as trained"
                yield _at_least(claim, results.difference(row, small), None)


def _wrong_noise(results: Results) -> Iterator[Verdict]:
    """What half or twice the true noise level costs the network."""
    losses = {}
    for key in results.rows:
        true = key._replace(restoration=NETWORK)
        if key.scenes == REAL and key.restoration.startswith(f"{NETWORK}, noise ") and true in results.rows:
            losses[key] = results.difference(true, key)
    worst = max(losses, key=lambda key: losses[key].mean, default=None)
    claim, target = "largest loss of a network by half or twice the noise level", f"at most {WRONG_NOISE_LOSS:g}"
    if worst is None:
        yield Verdict(claim, "no network takes a noise level", target, None)
    else:
        loss = losses[worst]
        level = worst.restoration.removeprefix(f"{NETWORK}, noise ")
        words = f"{loss}: {worst.system}, noise {worst.noise}, noise level {level}"
        yield Verdict(claim, words, target, loss.mean <= WRONG_NOISE_LOSS)


def _coded_against_flat(results: Results) -> Iterator[Verdict]:
    """Coded against flat at equal exposure time: of each kind the best on half A, networks and closed forms apart."""
    for noise in PHYSICAL:
        for restoration, kind in ((NETWORK, "networks"), (ENSEMBLE, "in 8 orientations"), (None, "closed forms")):
            both = _best_of_kinds(results, noise, restoration)
            if both is None and restoration == ENSEMBLE:
                continue
            names = "coded over flat" if both is None else f"{both[0].system} over {both[1].system}"
            gain = None if both is None else results.difference(*both)
            target = None if restoration is None else CODED_GAINS.get(noise)
            yield _at_least(f"{int(noise[:-1]):,} electrons, {kind}: {names}", gain, target)


def _recommended(results: Results, recommended: Mapping[str, str]) -> Iterator[Verdict]:
    """What `kornia-tidy design` recommends for each amount of light, against the other kind, both with networks."""
    for noise, kind in recommended.items():
        pair = _best_of_kinds(results, noise, NETWORK)
        gain = None if pair is None else results.difference(*(pair if kind == "coded" else pair[::-1]))
        claim = f"{int(noise[:-1]):,} electrons, networks: what design recommends ({kind}) over the other"
        measured = "not measured" if gain is None else f"{gain} ({gain.ahead} of {gain.pairs} scenes)"
        met = None if gain is None else gain.mean >= -2 * gain.error
        yield Verdict(claim, measured, "a loss of at most two standard errors", met)


def _best_of_kinds(results: Results, noise: str, restoration: str | None) -> tuple[Key, Key] | None:
    """Return the rows of coded and flat that are best on half A, of a restoration or, None, of closed forms.

    None unless there are both.
    """
    keys = results.keys(REAL, noise, restoration=restoration, network=restoration is not None)
    coded, flat = (
        results.best([key for key in keys if results.systems[key.system].kind == kind]) for kind in ("coded", "flat")
    )
    return (coded, flat) if coded is not None and flat is not None else None


def _joint(results: Results) -> Iterator[Verdict]:
    """Joint estimates: the image against the inversion by estimated depth, the depth against the best ramp."""
    layered = Key(REAL, FIXED[0], JOINT, BY_DEPTH)
    of_ramp = results.mean(Key(REAL, NO_NOISE, NO_CAMERA, BEST_RAMP), "depth_textured")
    for restoration in (NETWORK, ENSEMBLE):
        ours = layered._replace(restoration=restoration)
        if restoration == ENSEMBLE and ours not in results.rows:
            continue
        gain = results.difference(ours, layered) if {ours, layered} <= results.rows.keys() else None
        about = f"{JOINT}, noise {FIXED[0]}: {restoration}"
        yield _at_least(f"{about} over {BY_DEPTH}", gain, LAYERED_GAIN)
        error, surest = results.mean(ours, "depth_textured"), results.mean(ours, "depth_surest")
        known = math.isfinite(error) and math.isfinite(of_ramp)
        below = 1 - error / of_ramp if known else math.nan
        yield Verdict(
            f"{about}, depth RMSE over textured pixels below the best ramp of each scene",
            f"{100 * below:.0f} % ({error:.3f}, {of_ramp:.3f})" if known else "not measured",
            f"at least {100 * TEXTURED_GAIN:.0f} %",
            below >= TEXTURED_GAIN if known else None,
        )
        known = math.isfinite(surest)
        yield Verdict(
            f"{about}, depth RMSE over the {100 * SURE:.0f} % of each scene that it is surest of",
            f"{surest:.3f}" if known else "not measured",
            f"at most {SUREST_ERROR:.2f}",
            surest <= SUREST_ERROR if known else None,
        )


def _at_least(claim: str, gain: Difference | None, target: float | None) -> Verdict:
    wanted = "" if target is None else f"at least {target:g}"
    if gain is None or not gain.pairs:
        return Verdict(claim, "not measured", wanted, None)
    digits = 3 if target == SSIM_GAIN else 2
    measured = f"{gain.rounded(digits)} ({gain.ahead} of {gain.pairs} scenes)"
    return Verdict(claim, measured, wanted, None if target is None else gain.mean >= target)


def in_words(rows: Sequence[Verdict]) -> list[str]:
    """Return the lines of a Markdown table of verdicts."""
    lines = ["| | measured | target | |", "|---|---|---|---|"]
    for row in rows:
        word = {True: "met", False: "short", None: ""}[row.met]
        lines.append(f"| {row.claim} | {row.measured} | {row.target} | {word} |")
    return lines
