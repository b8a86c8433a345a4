"""Runs whose stored state has been changed: refused in a sentence, or resumed with nothing lost."""

from __future__ import annotations

import math
import random
import shutil

import pytest
import torch

from kornia_tidy.reconstruction.state_file import read_state, write_state
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")
from kornia_tidy.training import checkpoint, run
from kornia_tidy.training.settings import TrainingSettings
from kornia_tidy.training.stored_run import check_stored_run

SETTINGS = TrainingSettings(
    masks=1, width=4, size=48, scenes=4, validation_scenes=1, batch=2, epochs=2, window=23, head="plain", seed=3,
    schedule="cosine", fidelity="draft",
)  # fmt: skip
BATCHES = 2
DROPPED = object()
WRONG = (
    DROPPED, None, [], {}, (), "", "text", True, False, -1, 0, 1, 7, 0.5, -0.5, 10**30, math.nan, math.inf, [None],
    {"step": 1}, torch.ones(3), torch.ones(()), torch.full((2, 2), math.nan), torch.zeros(0),
)  # fmt: skip
# What nobody restores: other loops, notes. Lightning counts some batches anew.
UNUSED = (
    "epoch",
    "settings",
    "description",
    "loops/validate_loop",
    "loops/test_loop",
    "loops/predict_loop",
    "weights_stepped",
)
ANEW = ("val_loop", "epoch_loop.batch_progress/current/completed", "_batches_that_stepped", "manual_optimization")
# Scores, what generators and the optimiser keep, of the right shape; the task is compared when weights are loaded.
FREE = (
    "/best",
    "/waited",
    "/step",
    "/exp_avg",
    "/exp_avg_sq",
    "task",
    "/cuda",
    "/numpy/2",
    "/numpy/3",
    "/numpy/4",
    "/python/2",
)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The folder of a finished run, its states after each step, and a trainer and a module that would go on."""
    folder, states = tmp_path_factory.mktemp("stored") / "run", []

    def keep(path, state):
        write_state(path, state)
        if "optimizer_states" in state:
            states.append(read_state(path))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "write_state", keep)
        run.train(SETTINGS, folder, save_every=1)
        patch.setattr(run, "_fit", lambda *parts: states.append(parts[:2]))
        run.train(SETTINGS, folder, resume=True)
    return folder, states[:-1], states[-1]


def places(state, place=()):
    """The places of all values and containers of a nested state."""
    yield place
    if isinstance(state, (dict, list, tuple)):
        for key in state if isinstance(state, dict) else range(len(state)):
            yield from places(state[key], (*place, key))


def changed(state, place, value):
    """A state with another value at a place."""
    if not place:
        return value
    here = list(state) if isinstance(state, (list, tuple)) else dict(state)
    if value is DROPPED and len(place) == 1:
        del here[place[0]]
    else:
        here[place[0]] = changed(here[place[0]], place[1:], value) if place[1:] else value
    return tuple(here) if isinstance(state, tuple) else here


def variants(state):
    """Every change of every value that a resumed run restores, by its name."""
    for place in places({name: value for name, value in state.items() if name != "state_dict"}):
        name = "/".join(map(str, place))
        if place and not name.startswith(tuple(f"{other}/" for other in UNUSED)):
            for value in WRONG:
                yield name, value, changed(state, place, value)


class TestCheckStoredRun(BaseTester):
    def test_feature_every_state_of_a_run_is_accepted(self, stored):
        _, states, parts = stored
        assert [state["global_step"] for state in states] == [1, 2, 3, 4]
        for state in states:
            check_stored_run(state, *parts, BATCHES)

    @pytest.mark.parametrize("share", [0.1, pytest.param(1, marks=pytest.mark.slow)])
    def test_exception_every_part_is_there_and_of_its_type(self, share, stored):
        """Each value of a state in the middle of an epoch is dropped and replaced; what is accepted can do no harm."""
        _, states, parts = stored
        draw, tried, harmful = random.Random(5), 0, []
        for name, value, state in variants(states[2]):
            if draw.random() > share:
                continue
            tried += 1
            said = refusal(state, parts)
            if not (is_harmless(name, value, states[2]) if said is None else 10 < len(said) < 400):
                harmful.append((name, value, said))
        assert tried > 3000 * share
        assert harmful == []

    def test_feature_a_run_with_a_schedule_goes_on_in_the_middle_of_an_epoch(self, stored, tmp_path):
        """With the same batches, rates and bits."""
        folder, states, _ = stored
        assert states[2]["loops"]["fit_loop"]["state_dict"]["combined_loader"] == [{"epoch": 1, "batches": 1}]
        shutil.copytree(folder, tmp_path / "run")
        write_state(tmp_path / "run" / "last.safetensors", states[2])
        run.train(SETTINGS, tmp_path / "run", resume=True)
        one, other = (read_state(path / "last.safetensors")["state_dict"] for path in (folder, tmp_path / "run"))
        assert [name for name, weight in one.items() if not torch.equal(weight, other[name])] == []

    @pytest.mark.parametrize(
        ("place", "value", "sentence"),
        [
            (("optimizer_states",), [], "optimizer_states must be a list of 1, got 0"),
            (("optimizer_states",), DROPPED, "optimizer_states is missing"),
            (("optimizer_states", 0, "state", 3), DROPPED, "state must have entries of 11 of 11 weights by number"),
            (("optimizer_states", 0, "state"), {}, "state must have entries of 11 of 11 weights by number"),
            (("optimizer_states", 0, "param_groups", 1, "maximize"), True, "maximize must be False as in this run"),
            (("loops",), DROPPED, "loops is missing"),
            (("loops", "fit_loop", "epoch_progress"), None, "epoch_progress must be values by name, got None"),
            (("loops", "fit_loop", "epoch_progress", "reset"), 1, "epoch_progress has no 'reset'"),
            (("lr_schedulers", 0, "step"), None, "lr_schedulers/0 has no 'step'"),
            (("callbacks",), {}, "callbacks/SaveCheckpoints is missing"),
            (("callbacks", "SaveCheckpoints", "random"), [], "must be the states of the generators of every process"),
            (("global_step",), 10**30, "global_step must be a whole number from 0 to"),
            (("state_dict",), DROPPED, "it is a checkpoint without weights"),
            (("pytorch-lightning_version",), "1.0", "pytorch-lightning_version must be 2.6 or newer, got '1.0'"),
        ],
    )
    def test_exception_resuming_names_what_is_lost(self, place, value, sentence, stored, tmp_path):
        folder, states, _ = stored
        shutil.copytree(folder, tmp_path / "run")
        write_state(tmp_path / "run" / "last.safetensors", changed(states[2], place, value))
        with pytest.raises(ValueError, match=rf"^cannot (resume from|read) .*last\.safetensors: .*{sentence}"):
            run.train(SETTINGS, tmp_path / "run", resume=True)

    def test_exception_a_run_that_is_longer_than_asked_for(self, stored):
        folder, _, _ = stored
        with pytest.raises(ValueError, match="it has 2 epochs already, more than the 1 asked for"):
            run.train(SETTINGS.replace(epochs=1), folder, resume=True)


def refusal(state, parts):
    """What is said of a state, None if it is accepted. Another error than a sentence ends the test."""
    try:
        check_stored_run(state, *parts, BATCHES)
    except ValueError as error:
        return str(error)
    return None


def value_at(state, name):
    for key in name.split("/"):
        state = state[int(key) if key.isdigit() else key]
    return state


def is_harmless(name, value, state):
    old = value_at(state, name)
    same = type(value) is type(old) and repr(value) == repr(old)
    flag = value is DROPPED and (old is None or isinstance(old, bool))
    return same or flag or name in UNUSED or name.endswith(FREE) or any(part in name for part in ANEW)
