"""Training behind the camera that a design recommends."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.design import Candidate, CoDesign, DesignTask, Finalist, Verdict, design_files
from kornia_tidy.design.candidates import FLAT
from kornia_tidy.modulator import DwellTimes, GreyLevels, SpatialLightModulator
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.design_folder import designed_settings
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester

TASK = DesignTask(masks=2, depth_range=(0.5, 4.0), reference_f_number=10.0)


def phase_of(task):
    return torch.linspace(-3, 3, task.masks * task.mask_size**2).view(task.masks, task.mask_size, task.mask_size)


def folder_of_design(folder, gain, task=TASK):
    """A folder as `kornia-tidy design` writes it, in which masks at f/29 are ahead of a lens at f/41 by some dB."""
    flat = Candidate(FLAT, 41.0, 0.3, 0.02, math.nan, -17.0, None)
    coded = Candidate("focal sweep", 29.0, 0.0, 0.01, math.nan, -20.0, phase_of(task))
    scores = [Finalist(flat, {}, 30.0, (30.0, 31.0), 30.5, math.nan)]
    scores += [Finalist(coded, {}, 31.0, (30.0 + gain, 31.0 + gain), 30.5 + gain, math.nan)]
    verdict = Verdict(scores[0], scores[1], gain, 0.1, 2)
    folder.mkdir()
    for name, data in design_files(CoDesign(task, (flat, coded), tuple(scores), verdict, "words")).items():
        (folder / name).write_bytes(data)
    return folder


class TestDesignedSettings(BaseTester):
    def test_feature_the_recommended_masks_and_their_lens(self, tmp_path):
        settings = TrainingSettings(**designed_settings(folder_of_design(tmp_path / "a", 1.5)))
        assert (settings.masks, settings.f_number, settings.reference_f_number) == (2, 29.0, 10.0)
        assert settings.depth_range == (0.5, 4.0)
        assert settings.camera().focus_distance == pytest.approx(4.0)  # the far end
        assert settings.mask_size == 23

    def test_feature_a_recommended_lens_has_no_masks(self, tmp_path):
        settings = designed_settings(folder_of_design(tmp_path / "a", -0.5))
        assert (settings["masks"], settings["start"], settings["f_number"]) == (1, "flat", 41.0)
        assert settings["focus_distance"] == pytest.approx(1 / (0.25 + 0.3 * 1.75))

    def test_feature_a_focus_at_infinity(self, tmp_path):
        folder = folder_of_design(tmp_path / "a", 1.5, DesignTask(masks=2))
        assert designed_settings(folder)["focus_distance"] == math.inf
        assert designed_settings(folder)["depth_range"] == (0.2975, math.inf)

    def test_exception_a_modulator_that_trained_systems_do_not_have(self, tmp_path):
        slow = DesignTask(masks=2, modulator=SpatialLightModulator(GreyLevels(8), DwellTimes()))
        with pytest.raises(ValueError, match="designed for a modulator with switching, levels or losses"):
            designed_settings(folder_of_design(tmp_path / "a", 1.5, slow))
        assert designed_settings(folder_of_design(tmp_path / "b", -1.5, slow))["masks"] == 1

    def test_exception_a_real_lens_that_trained_systems_do_not_have(self, tmp_path):
        behind = DesignTask(masks=2, lens="double-gauss-50mm")
        with pytest.raises(ValueError, match="behind the lens double-gauss-50mm, and a trained system has an ideal"):
            designed_settings(folder_of_design(tmp_path / "a", 1.5, behind))

    @pytest.mark.parametrize("change", [{"task": 3}, {"recommended": {}}, {"recommended": None}])
    def test_exception_a_damaged_report(self, change, tmp_path):
        path = folder_of_design(tmp_path / "a", 1.5) / "report.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
        with pytest.raises(ValueError, match=r"report.json: it is no report of kornia-tidy design, or is damaged"):
            designed_settings(path.parent)


class TestTrainBehindADesign(BaseTester):
    SMALL = ("--learn", "network", "--head", "plain", "--width", "4", "--size", "32", "--scenes", "2", "--batch", "2")
    SHORT = ("--validation-scenes", "1", "--epochs", "1", "--fidelity", "draft", "--window", "9")

    @pytest.mark.parametrize(("gain", "size"), [(1.5, 23), (-0.5, 23), (1.5, 31)])
    def test_feature_the_trained_system_is_the_recommended_camera(self, gain, size, tmp_path):
        pytest.importorskip("lightning.pytorch")
        task = replace(TASK, mask_size=size)
        design = folder_of_design(tmp_path / "design", gain, task)
        given = (*self.SMALL, *self.SHORT, "--electrons", "500", "57000", "--design-from", str(design))
        assert main(["train", *given, "-o", str(tmp_path / "run")]) == 0
        system = load_trained(tmp_path / "run" / "best.safetensors")
        assert system.optics.camera.f_number == pytest.approx(29 if gain > 0 else 41)
        expected = phase_of(task) if gain > 0 else torch.zeros(1, 23, 23)
        self.assert_close(system.optics.masks.phase.detach(), expected)
        assert TrainingSettings.of(system).electrons == (500, 57e3)
