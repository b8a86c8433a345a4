"""Co-design of aperture, focus and masks: a search over f-numbers, decided by simulated captures.

The search minimises :func:`~kornia_tidy.design.candidates.cost_of`: first flat lenses and focal sweeps on a coarse
grid of f-numbers, then masks from several starts on a finer grid around the best. Finalists take simulated captures,
and :func:`~kornia_tidy.design.verdict.decide` chooses one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_part
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.design.candidates import DEPTH_FOCI, FOCI, STARTS, Candidate, coded_candidate, flat_candidate
from kornia_tidy.design.design_task import DesignTask
from kornia_tidy.design.simulated_captures import candidate_optics, leaf_scenes, score_candidate
from kornia_tidy.design.verdict import Finalist, Verdict, decide, finalist, in_words
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.thin_lens import FASTEST

STOP = 2**0.5
FOCUS_STEP = 0.1  # of the range of inverse depth
FLAT_FINALISTS = (STOP**-1, STOP**-0.5, 1.0, STOP**0.5, STOP)  # times the best f-number of the search
# The measure rates wide apertures too high, so slower ones are also finalists.
CODED_FINALISTS = (STOP**-0.5, 1.0, STOP**0.5, STOP)


@dataclass(frozen=True)
class Effort:
    """Extent of a search.

    Args:
        coarse_steps: gradient steps of each focal sweep on the coarse grid.
        steps: gradient steps of each mask on the fine grid.
        starts: what masks start from at the best f-number of the coarse grid.
        scenes: number of dead-leaves scenes, if no others are given.
        size: their side in pixels.

    Example:
        >>> Effort.quick().steps
        30
    """

    coarse_steps: int = 30
    steps: int = 100
    starts: tuple[str, ...] = STARTS
    scenes: int = 24
    size: int = 256

    @classmethod
    def quick(cls) -> Effort:
        """Return a shorter search, 20 s on one core: masks are optimised less, and the standard error is larger."""
        return cls(coarse_steps=12, steps=30, starts=STARTS[:2], scenes=12, size=192)


@dataclass(frozen=True, eq=False)
class CoDesign:
    """Result of a co-design.

    Args:
        task: the given task.
        candidates: all cameras of the search, in its order.
        finalists: candidates that took simulated captures.
        verdict: best masks against best flat lens.
        words: the verdict as a sentence.
    """

    task: DesignTask
    candidates: tuple[Candidate, ...]
    finalists: tuple[Finalist, ...]
    verdict: Verdict
    words: str

    @property
    def recommended(self) -> Candidate:
        """The recommended camera."""
        return self.verdict.recommended

    def optics(self, fidelity: str | Fidelity = "balanced") -> TiDyOptics:
        """Return the recommended camera with its masks and its sensor, for sRGB images."""
        optics = candidate_optics(self.task, self.recommended)
        return TiDyOptics(optics.masks, optics.camera, optics.modulator, optics.sensor, fidelity, lens=optics.lens)


def co_design(
    task: DesignTask,
    scenes: Sequence[Scene] | None = None,
    effort: Effort | None = None,
    seed: int = 0,
    progress: Callable[[str, int], None] | None = None,
) -> CoDesign:
    """Design aperture, focus and masks of a camera together, and decide whether the masks pay.

    Args:
        task: scene, lens, light, modulator, and what matters.
        scenes: captured in the decision beside dead leaves, at least 97 pixels a side; depths beyond the task's range
            are moved to its ends. Half of all scenes choose the settings, the other half decide.
        effort: extent of the search. Default: :class:`Effort`.
        seed: of starts, scenes and noise. The same seed gives the same result on the same machine.
        progress: called with the name of each stage and the units of work done in it, see :func:`planned_work`.

    Returns:
        The recommended camera, the table of candidates and the verdict.

    Raises:
        TypeError: if an argument is of another type.
        ValueError: if a scene is too small for PSFs of 129 pixels, or there are fewer than 4 scenes.

    Convention:
        - The flat lens has no modulator: no losses, no switching.
        - Masks are recommended only if they are ahead of the best flat lens by more than two standard errors.
        - Scores are those of closed forms. A network may gain more on one side than on the other.

    Source: Diaz, Goudail, Loiseaux and Huignard, Optics Letters 34(19) 2970 (2009), for design by the error of the best
    linear restoration; Cossairt, Gupta and Nayar, IEEE Transactions on Image Processing 22(2) 447 (2013), for the
    comparison at equal exposure time.

    Example:
        >>> tiny = Effort(coarse_steps=1, steps=1, starts=("focal sweep",), scenes=4, size=97)
        >>> result = co_design(DesignTask(masks=1, electrons=200), effort=tiny)
        >>> result.recommended.is_flat
        True
    """
    check_part("task", task, DesignTask, "a DesignTask")
    effort = Effort() if effort is None else effort
    tell = (lambda stage, amount: None) if progress is None else progress
    given = [*(scenes or ())]
    _check_scenes(given, effort)
    candidates = _search(task, effort, seed, tell)
    taken = _finalists(task, candidates)
    pictures = [*leaf_scenes(effort.scenes, effort.size, task.depth_range, seed), *given]
    finalists = []
    for candidate in taken:
        scores = []
        for score in score_candidate(task, candidate, pictures, seed):
            scores.append(score)
            tell("captures", 1)
        finalists.append(finalist(task, candidate, scores))
    verdict = decide(finalists)
    return CoDesign(task, tuple(candidates), tuple(finalists), verdict, in_words(task, verdict))


def planned_work(task: DesignTask, effort: Effort, scenes: int = 0) -> dict[str, int]:
    """Return the units of work of each stage: gradient steps, and captures.

    Example:
        >>> planned_work(DesignTask(), Effort())
        {'search': 980, 'captures': 216}
    """
    steps = len(task.f_numbers()) * effort.coarse_steps
    steps += (len(CODED_FINALISTS) + len(effort.starts) - 1 + 2) * effort.steps  # and two other foci
    return {"search": steps, "captures": (len(FLAT_FINALISTS) + len(CODED_FINALISTS)) * (effort.scenes + scenes)}


def _search(task: DesignTask, effort: Effort, seed: int, tell: Callable[[str, int], None]) -> list[Candidate]:
    """Return flat lenses and masks on the coarse grid, then on the fine grids around the best of both."""
    found: list[Candidate] = []

    def coded(start: str, f_number: float, focus: float, steps: int) -> Candidate:
        found.append(coded_candidate(task, start, f_number, focus, steps, seed, lambda: tell("search", 1)))
        return found[-1]

    def flat(f_number: float) -> Candidate:
        lenses = [flat_candidate(task, f_number, focus) for focus in (DEPTH_FOCI if task.depth_weight else FOCI)]
        best = min(lenses, key=lambda lens: lens.cost)
        found.append(best)
        return best

    coarse = []
    for f_number in task.f_numbers():
        lens = flat(f_number)
        coarse.append((lens, coded("focal sweep", f_number, _focus(task, lens), effort.coarse_steps)))
    best_flat = min((pair[0] for pair in coarse), key=lambda lens: lens.cost)
    best_coded = min((pair[1] for pair in coarse), key=lambda lens: lens.cost)
    for factor in FLAT_FINALISTS:
        f_number, known = best_flat.f_number * factor, [lens.f_number for lens, _ in coarse]
        if f_number >= FASTEST and not any(math.isclose(f_number, other) for other in known):
            flat(f_number)
    for factor in CODED_FINALISTS:
        if (f_number := best_coded.f_number * factor) >= FASTEST:
            for start in effort.starts if factor == 1 else effort.starts[:1]:
                coded(start, f_number, best_coded.focus, effort.steps)
    for focus in _neighbours(best_coded.focus):
        coded(effort.starts[0], best_coded.f_number, focus, effort.steps)
    return found


def _focus(task: DesignTask, lens: Candidate) -> float:
    """Return the focus of masks: that of the flat lens, or the middle where masks are to tell depth from both sides."""
    return 0.5 if task.depth_weight else lens.focus


def _neighbours(focus: float) -> tuple[float, float]:
    """Return two foci beside one, within the range."""
    return max(focus - FOCUS_STEP, 0.0), min(focus + FOCUS_STEP, 1.0)


def _finalists(task: DesignTask, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the flat lenses around the best one, and the best masks at each f-number around the best ones."""
    flats = _best_by_f_number([one for one in candidates if one.is_flat])
    coded = _best_by_f_number([one for one in candidates if not one.is_flat])
    return [*_around(flats, FLAT_FINALISTS), *_around(coded, CODED_FINALISTS)]


def _best_by_f_number(candidates: Sequence[Candidate]) -> list[Candidate]:
    best: dict[float, Candidate] = {}
    for one in candidates:
        key = round(one.f_number, 6)
        if key not in best or one.cost < best[key].cost:
            best[key] = one
    return list(best.values())


def _around(candidates: list[Candidate], factors: Sequence[float]) -> list[Candidate]:
    """Return those nearest to the best one's f-number times each factor, in the order of the f-number."""
    best = min(candidates, key=lambda one: one.cost)
    chosen = {
        id(near): near
        for factor in factors
        for near in [min(candidates, key=lambda one: abs(one.f_number / best.f_number / factor - 1))]
    }
    return sorted(chosen.values(), key=lambda one: one.f_number)


def _check_scenes(scenes: Sequence[Scene], effort: Effort) -> None:
    if (count := len(scenes) + effort.scenes) < 4:
        raise ValueError(f"a decision needs at least 4 scenes, two to choose settings and two to score, got {count}")
    for number, scene in enumerate(scenes):
        check_part(f"scene {number}", scene, Scene, "a Scene of image, depth and valid")
        if min(scene.image.shape[-2:]) < 97:
            raise ValueError(
                f"scene {number} must be at least 97 pixels a side for PSFs of 129 pixels, got "
                f"{tuple(scene.image.shape[-2:])}"
            )
