"""Checkpoints whose parts do not fit each other: refused in one sentence, before a camera or a network is made."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.masks import ZernikeMask
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import build_head, build_optics, load_masks, load_trained
from tests.base import BaseTester

SETTINGS = SystemSettings(
    task="joint", masks=2, head="plain", width=4, window=9, fidelity="draft", depth_range=(0.5, 2.0)
)


@pytest.fixture(scope="module")
def state():
    optics, head = build_optics(SETTINGS), build_head(SETTINGS)
    weights = {f"optics.{name}": value for name, value in optics.state_dict().items()}
    weights |= {f"head.{name}": value for name, value in head.state_dict().items()}
    return {"settings": SETTINGS.as_dict(), "state_dict": weights, "global_step": 3}


class TestLoadTrained(BaseTester):
    def test_smoke_a_whole_one(self, state, tmp_path):
        write_state(tmp_path / "a", state)
        assert load_trained(tmp_path / "a").step == 3

    def test_feature_settings_of_the_run_are_kept_and_do_not_matter(self, state, tmp_path):
        run = {"augment": 1, "from the future": [2.5]}
        write_state(tmp_path / "a", {**state, "settings": {**state["settings"], **run}})
        system = load_trained(tmp_path / "a")
        assert system.settings == SETTINGS
        assert system.run == run

    @pytest.mark.parametrize(
        ("changes", "sentence"),
        [
            ({"masks": "5"}, "masks must be a whole number from 0 to 1024, got '5'"),
            ({"masks": 900}, "it holds 2 masks, and its settings tell of 900"),
            ({"mask_size": 46}, "it holds masks of 23 pixels along a side, its settings tell of 46"),
            ({"width": 10**4}, "head does not fit: layers.0.weight is"),
            ({"width": 10**18}, "no network can be made by its settings"),
            ({"task": ["joint"]}, "task must be one of .*, got .'joint'."),
            ({"focal_length": 10**400}, "must have at most 300 digits, got 401"),
            ({"window": 4001}, "PSFs of window 4001 at [0-9]+ depths must take at most 128 MiB, got [0-9]+"),
            ({"depth_classes": 1, "refocus": 2}, "a distribution of depth needs depth_classes of at least 2, got 1"),
            ({"depth_classes": 8, "refocus": 1}, "a distribution of depth needs refocus of at least 2, got 1"),
            ({"depth_classes": 8, "refocus": 2, "residual": True}, "got the task 'joint' with residual"),
            ({"depth_classes": 8, "refocus": 2, "task": "depth"}, "got the task 'depth'"),
            ({"fine": True, "refocus": 2}, "fine is for closed_form with refocus and without depth_classes"),
            ({"fine": True, "closed_form": True}, "fine is for closed_form with refocus and without depth_classes"),
        ],
    )
    def test_exception_settings_that_cannot_be(self, changes, sentence, state, tmp_path):
        write_state(tmp_path / "a", {**state, "settings": {**state["settings"], **changes}})
        with pytest.raises(ValueError, match=sentence) as error:
            load_trained(tmp_path / "a")
        assert len(str(error.value)) < 600

    @pytest.mark.parametrize(
        "changes",
        [
            {"settings": 5},
            {"settings": [1]},
            {"state_dict": 5},
            {"state_dict": {"head.weight": 5}},
            {"global_step": None},
            {"global_step": "3"},
        ],
    )
    def test_exception_parts_that_cannot_be(self, changes, state, tmp_path):
        write_state(tmp_path / "a", {**state, **changes})
        with pytest.raises(ValueError, match=f"cannot read {tmp_path / 'a'}: "):
            load_trained(tmp_path / "a")

    def test_exception_a_file_does_not_choose_a_module_to_import(self, state, tmp_path, monkeypatch):
        """Which would run its code."""
        (tmp_path / "bad_module.py").write_text("raise SystemExit('it was run')")
        monkeypatch.syspath_prepend(tmp_path)
        settings = {**state["settings"], "head": "bad_module:Network"}
        write_state(tmp_path / "a", {**state, "settings": settings})
        with pytest.raises(ValueError, match="if you trust the file, import bad_module before it is loaded"):
            load_trained(tmp_path / "a")


class TestLoadMasks(BaseTester):
    def test_feature_pixels_take_the_phase_that_was_limited(self, tmp_path):
        saved = TiDyOptics(ZernikeMask(2, constraint="wrapped", max_height=8e-7), fidelity="draft")
        save_file(saved.state_dict(), tmp_path / "a.safetensors")
        optics = TiDyOptics(PixelwiseMask(2), fidelity="draft")
        load_masks(tmp_path / "a.safetensors", optics)
        assert torch.equal(optics.masks.phase, saved.masks.phase)

    def test_exception_other_limits(self, tmp_path):
        saved = TiDyOptics(PixelwiseMask(2, constraint="wrapped"), fidelity="draft")
        save_file(saved.state_dict(), tmp_path / "a.safetensors")
        optics = TiDyOptics(PixelwiseMask(2, constraint="clamp"), fidelity="draft")
        before = optics.masks.phase.detach().clone()
        with pytest.raises(ValueError, match="constraint is 'wrapped' in the state and 'clamp' here"):
            load_masks(tmp_path / "a.safetensors", optics)
        assert torch.equal(optics.masks.phase, before)
