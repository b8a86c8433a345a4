"""Decision between flat lens and masks, by scores of simulated captures: paired over scenes, with standard error."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from kornia_tidy.design.candidates import Candidate
from kornia_tidy.design.design_task import DesignTask
from kornia_tidy.design.simulated_captures import Scores

NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")


@dataclass(frozen=True, eq=False)
class Finalist:
    """A candidate with its scores on simulated captures.

    Args:
        candidate: the camera.
        settings: of the closed forms, for image and depth, the best ones on the first half of the scenes.
        chosen_by: mean score in dB on the first half, which chooses finalists.
        scores: in dB on each scene of the second half, weighted as the task says.
        image: mean PSNR on the second half in dB; NaN if the image has no weight.
        depth: root mean square of the scenes' depth errors there, as a fraction of the range; NaN if depth has none.
    """

    candidate: Candidate
    settings: dict[str, str]
    chosen_by: float
    scores: tuple[float, ...]
    image: float
    depth: float

    @property
    def score(self) -> float:
        """Mean score on the second half of the scenes in dB."""
        return statistics.fmean(self.scores)


@dataclass(frozen=True, eq=False)
class Verdict:
    """What simulated captures say of the best masks and the best flat lens.

    Args:
        flat: best flat lens on the first half of the scenes.
        coded: best masks on it.
        gain: of the masks over the flat lens on the second half, mean over its scenes, in dB.
        standard_error: of the gain, from its spread over the scenes, in dB.
        scenes: number of scenes in the second half.
    """

    flat: Finalist
    coded: Finalist
    gain: float
    standard_error: float
    scenes: int

    @property
    def coding_pays(self) -> bool:
        """Whether the masks are ahead by more than two standard errors."""
        return self.gain > 2 * self.standard_error

    @property
    def recommended(self) -> Candidate:
        """The masks where they pay, else the flat lens, which is simpler."""
        return self.coded.candidate if self.coding_pays else self.flat.candidate


def finalist(task: DesignTask, candidate: Candidate, scores: Sequence[Scores]) -> Finalist:
    """Return a candidate with its scores: settings chosen on scenes 0, 2, 4, ..., scores taken on 1, 3, 5, ...

    Example:
        >>> from kornia_tidy.design.candidates import FLAT
        >>> flat = Candidate(FLAT, 50.0, 0.5, 0.02, math.nan, -17.0, None)
        >>> scores = [{"image": {"sharp": 30.0, "soft": 29.0}}, {"image": {"sharp": 20.0, "soft": 29.0}}]
        >>> finalist(DesignTask(), flat, scores).score
        20.0
    """
    first, second = scores[::2], scores[1::2]
    weights = {"image": 1 - task.depth_weight, "depth": task.depth_weight}
    settings: dict[str, str] = {}
    for part in scores[0]:
        settings[part] = max(first[0][part], key=lambda name: statistics.fmean(scene[part][name] for scene in first))

    def weighted(scene: Scores) -> float:
        return sum(weights[part] * scene[part][setting] for part, setting in settings.items())

    def mean_of(part: str) -> float:
        if part not in settings:
            return math.nan
        return statistics.fmean(scene[part][settings[part]] for scene in second)

    return Finalist(
        candidate,
        settings,
        statistics.fmean(map(weighted, first)),
        tuple(map(weighted, second)),
        mean_of("image"),
        10 ** (-mean_of("depth") / 20),
    )


def decide(finalists: Sequence[Finalist]) -> Verdict:
    """Return the verdict on finalists, at least one of them flat and one with masks.

    Both are chosen on the first half of the scenes and compared on the second, so that the best of several is not
    flattered by the choice.
    """
    flat, coded = (
        max((one for one in finalists if one.candidate.is_flat is is_flat), key=lambda one: one.chosen_by)
        for is_flat in (True, False)
    )
    differences = [ours - theirs for ours, theirs in zip(coded.scores, flat.scores, strict=True)]
    error = statistics.stdev(differences) / math.sqrt(len(differences))
    return Verdict(flat, coded, statistics.fmean(differences), error, len(differences))


def in_words(task: DesignTask, verdict: Verdict) -> str:
    """Return the verdict as a sentence."""
    flat, coded = verdict.flat.candidate, verdict.coded.candidate
    masks = f"{_number(task.masks)} mask{'s' if task.masks > 1 else ''} at f/{coded.f_number:.3g}"
    gain = f"{verdict.gain:+.2f} ± {verdict.standard_error:.2f} dB"
    slowest = "stopped-down " if flat.f_number > coded.f_number else "flat "
    if verdict.coding_pays:
        return f"{masks}: {gain} over the best {slowest}lens (f/{flat.f_number:.3g})"
    advice = "stop down to" if slowest == "stopped-down " else "take the flat lens at"
    return f"at this light {advice} f/{flat.f_number:.3g}: coding gains nothing (the best, {masks}: {gain})"


def _number(count: int) -> str:
    return NUMBERS[count] if count < len(NUMBERS) else str(count)
