from __future__ import annotations

import importlib
import io
import json
import math

import numpy as np
import pytest
import torch
from safetensors.torch import load

from kornia_tidy import PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.data import Scene
from kornia_tidy.design import DesignTask, Effort, co_design, design_files, planned_work
from kornia_tidy.design.design_report import CAMERA, DATA, MASKS
from kornia_tidy.design.simulated_captures import candidate_optics, leaf_scenes
from tests.base import BaseTester

module = importlib.import_module("kornia_tidy.design.co_design")  # the package has a function of this name
TINY = Effort(coarse_steps=2, steps=4, starts=("focal sweep",), scenes=4, size=97)
DIM = DesignTask(masks=1, electrons=60)


@pytest.fixture(scope="module")
def dim():
    return co_design(DIM, effort=TINY)


@pytest.fixture(scope="module")
def bright():
    """Two masks in bright light, and what was told of the progress."""
    told = []
    design = co_design(DesignTask(masks=2), effort=TINY, progress=lambda stage, amount: told.append((stage, amount)))
    return design, told


class TestCoDesign(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_in_little_light_nothing_is_coded(self, dim):
        assert dim.recommended.is_flat
        assert "coding gains nothing" in dim.words
        assert f"f/{dim.recommended.f_number:.3g}" in dim.words

    @pytest.mark.takes_seconds
    def test_feature_the_same_seed_the_same_result(self, dim):
        again = co_design(DIM, effort=TINY)
        assert [one.scores for one in again.finalists] == [one.scores for one in dim.finalists]
        assert again.words == dim.words

    @pytest.mark.takes_seconds
    def test_feature_in_bright_light_masks_pay(self, bright):
        design, _ = bright
        assert not design.recommended.is_flat
        assert design.words.startswith("two masks at f/")
        assert design.verdict.gain > 2 * design.verdict.standard_error

    @pytest.mark.takes_seconds
    def test_feature_the_camera_is_the_recommended_one(self, bright):
        design, _ = bright
        optics = design.optics()
        assert isinstance(optics.camera, ThinLensCamera)
        assert optics.camera.f_number == pytest.approx(design.recommended.f_number)
        assert optics.sensor.full_well == pytest.approx(57_000 * (17.6 / design.recommended.f_number) ** 2)
        self.assert_close(optics.masks.phase.detach(), design.recommended.phase)

    def test_feature_the_table_holds_flat_lenses_and_masks_and_the_finalists(self, bright):
        design, _ = bright
        assert {one.is_flat for one in design.candidates} == {True, False}
        assert {id(one.candidate) for one in design.finalists} <= {id(one) for one in design.candidates}
        assert min(design.candidates, key=lambda one: one.cost) in [one.candidate for one in design.finalists]

    def test_feature_progress_is_told_as_planned(self, bright):
        design, told = bright
        planned = planned_work(design.task, TINY)
        done = {stage: sum(amount for one, amount in told if one == stage) for stage in planned}
        assert done["search"] == planned["search"]
        assert done["captures"] == len(design.finalists) * TINY.scenes <= planned["captures"]

    def test_exception_scenes(self):
        scene = leaf_scenes(1, 96, (0.3, math.inf))[0]
        with pytest.raises(ValueError, match=r"scene 0 must be at least 97 pixels a side .*, got \(96, 96\)"):
            co_design(DIM, [scene])
        with pytest.raises(TypeError, match="scene 0 must be a Scene"):
            co_design(DIM, [scene.image])
        with pytest.raises(ValueError, match="a decision needs at least 4 scenes"):
            co_design(DIM, effort=Effort(1, 1, ("focal sweep",), scenes=3, size=97))
        with pytest.raises(TypeError, match="task must be a DesignTask, got"):
            co_design(None)


class TestDesignFiles(BaseTester):
    def test_feature_camera_masks_and_numbers_can_be_read_back(self, bright):
        design, _ = bright
        files = design_files(design)
        optics = TiDyOptics(PixelwiseMask(2), sensor=SensorNoise(0.1, full_well=1.0))
        optics.load_state_dict(load(files[CAMERA]), take_over=True)
        assert optics.camera.f_number == pytest.approx(design.recommended.f_number)
        self.assert_close(optics.masks.phase.detach(), design.recommended.phase)
        heights = np.load(io.BytesIO(files[MASKS]))
        self.assert_close(torch.from_numpy(heights), design.recommended.masks.heights().detach().double())
        data = json.loads(files[DATA])
        assert (data["words"], data["gain_dB"]) == (design.words, design.verdict.gain)
        assert data["task"]["depth_range"] == [0.2975, None]
        assert len(data["candidates"]) == len(design.candidates)


class TestLeafScenes(BaseTester):
    def test_feature_the_same_seed_the_same_scenes(self):
        first, again, other = (leaf_scenes(1, 48, (0.5, 4.0), seed)[0] for seed in (1, 1, 2))
        assert torch.equal(first.image, again.image)
        assert not torch.equal(first.image, other.image)
        assert isinstance(first, Scene)
        assert float(first.depth.min()) >= 0.5
        assert float(first.depth.max()) <= 4.0


class TestCandidateOptics(BaseTester):
    def test_feature_the_flat_lens_has_no_modulator(self, bright):
        design, _ = bright
        flat = candidate_optics(design.task, design.verdict.flat.candidate)
        assert not flat.masks.phase.detach().any()
        assert flat.fidelity.window == 129
        assert flat.fidelity.stray_light == "veil"
