"""Shipped systems that are trained further under one condition of capture and scored under several.

It tells what training for a condition wins back, such as slow swaps of masks: beside each system stands the same one
after as many steps without the condition, so that the steps alone are no gain. Batch normalisation keeps the statistics
that the system was shipped with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from examples.paper.cameras import F_NUMBER
from examples.paper.closed_forms import ClosedForms
from examples.paper.report import cell, grid
from examples.paper.runner import Row, Trial
from examples.paper.scenes import Budget, painted, real
from examples.paper.shipped import ELECTRONS, load_shipped, with_parts
from examples.paper.training import best_temperature, fit, mean_scores, prefixed, system_of
from kornia_tidy import TiDyOptics
from kornia_tidy.reconstruction.trained import TrainedSystem

AS_SHIPPED = "as shipped"
Conditions = Mapping[str, Mapping[str, Any]]
"""Arguments of :class:`~kornia_tidy.TiDyOptics` that differ from the shipped camera's, by the name of the condition."""
BUDGETS = {
    "smoke": Budget(size=48, scenes=2, batch=2, steps=2, scored=2, real=0, seeds=1),
    "cpu": Budget(size=128, steps=160, real_size=128, lr=3e-5, lr_metres=2e-8),
    "gpu": Budget(
        size=256, scenes=5077, batch=32, steps=2000, scored=64, real=35, real_size=256, seeds=3, lr=3e-5,
        lr_metres=2e-8, accelerator="gpu",
    ),
}  # fmt: skip
BUDGETS["paper"] = BUDGETS["gpu"]


def further_trials(systems: Mapping[str, Sequence[str]], scale: str) -> list[Trial]:
    """Return the trials: systems as shipped, then systems trained further, by condition and seed.

    Args:
        systems: names of conditions to train under, by system.
        scale: of the experiment.
    """
    seeds = range(BUDGETS[scale].seeds)
    shipped = [{"system": name, "trained": AS_SHIPPED, "seed": "0"} for name in systems]
    further = [
        {"system": name, "trained": condition, "seed": str(seed)}
        for seed in seeds
        for name, trained in systems.items()
        for condition in trained
    ]
    return [*shipped, *further]


def crossed_scores(
    trial: Trial,
    scale: str,
    conditions: Conditions,
    scored: Sequence[str],
    before_step: Callable[[TiDyOptics, int], None] | None = None,
) -> Mapping[str, float | str]:
    """Train a shipped system further and return the scores of network and closed form under each condition.

    Args:
        trial: the system, what it is trained with, and the seed.
        scale: of the experiment.
        conditions: by name.
        scored: names of the conditions under which it is scored.
        before_step: function that is called with the camera and the number of each step before it.

    Returns:
        Scores by what restored the captures, condition, scenes and score, such as ``network_4 ms_painted_psnr``.
    """
    budget, shipped = BUDGETS[scale], load_shipped(trial["system"])
    system = shipped
    if trial["trained"] != AS_SHIPPED:
        optics = with_parts(shipped.optics, **conditions[trial["trained"]])
        optics.masks.requires_grad_(requires_grad=True)
        hook = None if before_step is None else lambda step: before_step(optics, step)
        fit(optics, shipped.head, shipped.settings, budget, int(trial["seed"]), hook)
        system = shipped._replace(optics=optics)
    found: dict[str, float | str] = {"task": shipped.settings.task}
    for name in scored:
        found |= scores_under(system, name, conditions[name], budget)
    return found


def scores_under(system: TrainedSystem, name: str, parts: Mapping[str, Any], budget: Budget) -> dict[str, float]:
    """Return the scores of a system's network, and of the closed form behind its masks, under one condition."""
    optics, task = with_parts(system.optics, **parts), system.settings.task
    network = system_of(optics, system.head, system.settings, system.step)
    closed = system_of(optics, ClosedForms(optics, task), system.settings, 0)
    if task != "edof":
        best_temperature(closed, painted(budget, "validation", min(8, budget.scored)))
    found = {}
    for where, scenes in (("painted", painted(budget, "test", budget.scored)),
                          ("real", real(budget.real, budget.real_size))):  # fmt: skip
        for what, restored in (("network", network), ("closed", closed)):
            scores = mean_scores(restored, scenes)
            found |= prefixed(f"{what}_{name}", {f"{where}_{score}": value for score, value in scores.items()})
    return found


def crossed_table(rows: Sequence[Row], scored: Sequence[str], what: str) -> str:
    """Return the table of scores: a row for each training, a column for each condition of the scored captures.

    Args:
        rows: of the experiment.
        scored: names of the conditions.
        what: ``"network"`` or ``"closed"``.
    """
    lines = []
    for name, trained in dict.fromkeys((row["system"], row["trained"]) for row in rows):
        own = [row for row in rows if (row["system"], row["trained"]) == (name, trained)]
        scores = (cell(own, f"{what}_{condition}", own[0]["task"]) for condition in scored)
        lines.append([name, trained, str(len(own)), *scores])
    return grid(["system", "trained further with", "seeds", *scored], lines)


def further_conditions(scale: str) -> str:
    """Return budget, scenes and noise in words."""
    budget = BUDGETS[scale]
    return (
        f"Trained further for {budget.steps} steps of {budget.batch} of {budget.scenes} painted scenes of "
        f"{budget.size} px, learning rates {budget.lr:g} and {budget.lr_metres:g} m ({budget.schedule}); scored on "
        f"{budget.scored} other painted scenes and {budget.real} real ones of {budget.real_size} px; "
        f"{ELECTRONS:g} electrons of white at f/{F_NUMBER}; seeds {budget.seeds}."
    )
