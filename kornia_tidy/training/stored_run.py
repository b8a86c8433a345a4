"""Check of a stored run: names, types and ranges of all that Lightning and PyTorch restore without looking at it.

Lightning goes on without a word where states of optimisers or loops are missing, and PyTorch sets whatever attributes a
state names. So the stored state is compared with the one that the same run has before its first step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import lightning.pytorch as pl
import torch
from packaging.version import InvalidVersion, Version
from torch import Tensor

from kornia_tidy.training.callbacks import SaveCheckpoints
from kornia_tidy.training.module import STEPPED, TidyTraining
from kornia_tidy.training.random_state import check_random_states

MOST = 1 << 53  # of steps, batches and epochs
OLDEST = Version("2.6")  # Lightning; its loops have these names
LAST_BATCH = "is_last_batch"  # the one flag that changes during a run
COUNTED = ("ready", "started", "processed", "completed")  # one after the other
_MISSING = object()


def check_stored_run(state: Mapping[str, Any], trainer: pl.Trainer, module: TidyTraining, batches: int) -> None:
    """Raise ``ValueError`` unless a run can go on from a state with nothing lost.

    Args:
        state: as :func:`~kornia_tidy.reconstruction.state_file.read_state` returns it. Its weights are compared
            elsewhere, when they are loaded.
        trainer: of the run, before it is fitted.
        module: of the run.
        batches: of an epoch.

    Raises:
        ValueError: if a part is missing, unknown, of another type or out of its range; the message names it.
    """
    like: dict[str, Any] = {"epoch": 0, "global_step": 0, "task": "", "description": {}}
    for name, value in like.items():
        _check_kind(state.get(name, _MISSING), value, name)
    for name, words in state["description"].items():
        _check(words, "", f"description/{name}")
    version = state.get("pytorch-lightning_version", _MISSING)
    _check(version, "", "pytorch-lightning_version")
    try:
        recent = Version(version) >= OLDEST
    except InvalidVersion:
        recent = False
    if not recent:
        raise ValueError(f"pytorch-lightning_version must be {OLDEST} or newer, got {version!r:.80}")
    adam = module.adam()
    _check_loops(state, trainer, batches)
    _check_schedule(state, adam, module)  # which notes the initial rates in the optimiser
    _check_optimiser(state, adam)
    _check_callbacks(state)
    if scale := trainer.precision_plugin.state_dict():  # of half precision on a GPU
        name = type(trainer.precision_plugin).__qualname__
        _check(state.get(name, _MISSING), scale, name)


def _check_schedule(state: Mapping[str, Any], adam: torch.optim.Optimizer, module: TidyTraining) -> None:
    place = "lr_schedulers"
    schedules = [] if module.run.schedule == "constant" else [torch.optim.lr_scheduler.LambdaLR(adam, lambda _: 1.0)]
    _check(state.get(place, _MISSING), [each.state_dict() for each in schedules], place)
    done = state["loops"]["fit_loop"]["epoch_loop.scheduler_progress"]["total"]["completed"]
    for schedule, stored in zip(schedules, state[place], strict=True):
        own = {"last_epoch": done, "_step_count": done + 1, "base_lrs": schedule.base_lrs}
        _check_same(stored, own, f"{place}/0")
        for group, rate in zip(adam.param_groups, stored["_last_lr"], strict=True):
            group["lr"] = rate  # of the next step


def _check_optimiser(state: Mapping[str, Any], adam: torch.optim.Optimizer) -> None:
    place, like = "optimizer_states", adam.state_dict()
    _check(state.get(place, _MISSING), [_MISSING], place)
    [stored], weights = state[place], [weight for group in adam.param_groups for weight in group["params"]]
    _check(stored, {"state": _MISSING, "param_groups": like["param_groups"]}, f"{place}/0")
    groups, moments = stored["param_groups"], stored.get("state", _MISSING)
    for number, group in enumerate(groups):
        where = f"{place}/0/param_groups/{number}"
        if group["params"] != like["param_groups"][number]["params"]:
            raise ValueError(f"{where}/params are not the numbers of this run's weights")
        numbers = {name: own for name, own in like["param_groups"][number].items() if type(own) in (int, float, tuple)}
        _check_same(group, numbers, where)
    _check_kind(moments, {}, f"{place}/0/state")
    stepped = state.get(STEPPED, max(1, len(moments)))  # runs of earlier versions do not tell
    _check_kind(stepped, 0, STEPPED)
    if len(moments) != stepped or not set(moments) <= set(range(len(weights))):
        raise ValueError(f"{place}/0/state must have entries of {stepped} of {len(weights)} weights by number")
    for number, entry in moments.items():
        where, weight = f"{place}/0/state/{number}", weights[number].detach()
        _check(entry, {"step": torch.ones(()), "exp_avg": weight, "exp_avg_sq": weight}, where)
        if not 0 < entry["step"] <= state["global_step"] or bool((entry["exp_avg_sq"] < 0).any()):
            raise ValueError(f"{where} must have steps up to global_step and squares that are not negative")


def _check_loops(state: Mapping[str, Any], trainer: pl.Trainer, batches: int) -> None:
    place, like = "loops/fit_loop", trainer.fit_loop.state_dict()
    like["state_dict"] = {"combined_loader": [{"epoch": 0, "batches": 0}]}
    _check_kind(state.get("loops", _MISSING), {}, "loops")
    stored = state["loops"].get("fit_loop", _MISSING)
    _check(stored, like, place)
    _check_counts({name: part for name, part in stored.items() if "val_loop" not in name}, place)  # that starts anew
    epochs, done = stored["epoch_progress"]["current"], stored["epoch_loop.batch_progress"]
    steps = stored["epoch_loop.automatic_optimization.optim_progress"]["optimizer"]["step"]["total"]["completed"]
    [loader] = stored["state_dict"]["combined_loader"]
    for name, value, same in (
        ("global_step", state["global_step"], (steps,)),
        ("epoch", state["epoch"], (epochs["processed"], epochs["processed"] - 1)),
        (f"{place}/state_dict/combined_loader/0/batches", loader["batches"], (done["current"]["ready"],)),
        (f"{place}/epoch_loop.batch_progress/current/processed", done["current"]["processed"], (loader["batches"],)),
        (f"{place}/state_dict/combined_loader/0/epoch", loader["epoch"], (epochs["ready"] - 1,)),
    ):
        if value not in same:
            raise ValueError(f"{name} must be {same[0]} as the loops count, got {value}")
    if loader["batches"] > batches or (done[LAST_BATCH] and loader["batches"] < batches):
        raise ValueError(
            f"{place} counts {loader['batches']} of {batches} batches, and {LAST_BATCH} {done[LAST_BATCH]}"
        )
    if trainer.max_epochs is not None and epochs["processed"] > trainer.max_epochs > -1:
        raise ValueError(f"it has {epochs['processed']} epochs already, more than the {trainer.max_epochs} asked for")


def _check_counts(stored: Any, place: str) -> None:
    """Raise ``ValueError`` unless completed items were processed, started and ready before."""
    if not isinstance(stored, Mapping):
        return
    if "ready" in stored:
        counts = [stored[name] for name in COUNTED if name in stored]
        one = int("processed" in stored)  # saved while a batch or an epoch is not completed yet
        if any(later > earlier for earlier, later in pairwise(counts)) or counts[0] - counts[-1] > one:
            raise ValueError(f"{place} must be equal counts, or one more that are not completed, got {counts}")
        if stored["ready"] != stored.get("started", stored["ready"]):
            raise ValueError(f"{place} must have started what is ready, got {counts}")
    for name, inner in stored.items():
        _check_counts(inner, f"{place}/{name}")
    if "total" in stored and any(stored["current"][name] > stored["total"][name] for name in stored["total"]):
        raise ValueError(f"{place}/current must not count more than {place}/total")


def _check_same(stored: Mapping[str, Any], own: Mapping[str, Any], place: str) -> None:
    """Raise ``ValueError`` unless stored numbers are those that follow from the settings of the run."""
    for name, value in own.items():
        pairs = zip(
            *(part if isinstance(part, (list, tuple)) else [part] for part in (stored[name], value)), strict=True
        )
        if not all(math.isclose(one, other, rel_tol=1e-6) for one, other in pairs):
            raise ValueError(f"{place}/{name} must be {value} as in this run, got {stored[name]}")


def _check_callbacks(state: Mapping[str, Any]) -> None:
    place = f"callbacks/{SaveCheckpoints.__name__}"
    _check_kind(state.get("callbacks", _MISSING), {}, "callbacks")
    stored = state["callbacks"].get(SaveCheckpoints.__name__, _MISSING)
    _check(stored, {"best": _MISSING, "waited": 0, "random": _MISSING}, place)
    best = stored.get("best", math.nan)
    if isinstance(best, bool) or not isinstance(best, (int, float)) or math.isnan(best) or best == -math.inf:
        raise ValueError(f"{place}/best must be a score, or infinity, got {best!r:.80}")
    check_random_states(stored.get("random"), f"{place}/random")


def _check(value: Any, like: Any, place: str) -> None:
    """Raise ``ValueError`` unless a value is like another one in kind, and so is all that is in it."""
    flag = (like is None or isinstance(like, bool)) and not place.endswith(LAST_BATCH)
    if like is _MISSING or (flag and value is _MISSING):  # versions of PyTorch differ in their flags, and have defaults
        return
    _check_kind(value, like, place)
    if isinstance(like, Mapping):
        if unknown := [name for name in value if name not in like]:
            raise ValueError(f"{place} has no {unknown[0]!r:.80}")
        for name, entry in like.items():
            _check(value.get(name, _MISSING), entry, f"{place}/{name}")
    if isinstance(like, (list, tuple)):
        if len(value) != len(like):
            raise ValueError(f"{place} must be a list of {len(like)}, got {len(value)}")
        for number, (entry, own) in enumerate(zip(value, like, strict=True)):
            _check(entry, own, f"{place}/{number}")


def _check_kind(value: Any, like: Any, place: str) -> None:
    """Raise ``ValueError`` unless a value is of the type of another one, and in the range that such values have."""
    if value is _MISSING:
        raise ValueError(f"{place} is missing")
    if isinstance(like, Mapping):
        fits, kind = isinstance(value, Mapping), "values by name"
    elif isinstance(like, (list, tuple)):
        fits, kind = isinstance(value, (list, tuple)), "a list"
    elif isinstance(like, str):
        fits, kind = isinstance(value, str), "a text"
    elif isinstance(like, Tensor):
        fits = isinstance(value, Tensor) and value.shape == like.shape and value.is_floating_point()
        fits, kind = fits and bool(value.isfinite().all()), f"finite numbers of shape {tuple(like.shape)}"
    elif place.endswith(LAST_BATCH):
        fits, kind = isinstance(value, bool), "true or false"
    elif like is None or isinstance(like, bool):
        fits, kind = value is like, f"{like} as in this run"
    else:
        whole = isinstance(like, int)
        fits = isinstance(value, int if whole else (int, float)) and not isinstance(value, bool) and 0 <= value <= MOST
        kind = f"a {'whole ' if whole else ''}number from 0 to {MOST}"
    if not fits:
        raise ValueError(f"{place} must be {kind}, got {value!r:.80}")
