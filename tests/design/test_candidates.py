from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.data import SceneStatistics
from kornia_tidy.design import restoration_error
from kornia_tidy.design.candidates import STARTS, coded_candidate, cost_of, flat_candidate, initial_phase, search_lens
from kornia_tidy.design.design_task import DesignTask, mask_of
from kornia_tidy.design.simulated_captures import candidate_optics, leaf_scenes, score_candidate
from kornia_tidy.modulator import GreyLevels, SpatialLightModulator, Switching
from tests.base import BaseTester

FEW = 3  # gradient steps
LIKE_OTHERS = SceneStatistics(2.9, 1 / 256, 0.29, 0.23)


class TestFlatCandidate(BaseTester):
    def test_feature_f_numbers_rank_as_another_program_found(self):
        """Errors of .0210, .0263, .0369, .0594 and .0875 at 57,000 electrons."""
        task = DesignTask(statistics=LIKE_OTHERS)
        errors = [flat_candidate(task, f_number, 0.5).image_error for f_number in (50, 71, 35, 25, 17.6)]
        assert errors == sorted(errors)


class TestCodedCandidate(BaseTester):
    def test_feature_several_masks_beat_the_best_flat_lens_in_bright_light(self):
        """At 57,000 electrons another program found .0143 at f/25 against .0210, the best flat lens at f/50."""
        task = DesignTask(statistics=LIKE_OTHERS)
        masks = coded_candidate(task, "focal sweep", 25.0, 0.5, 20)
        assert masks.image_error < 0.9 * flat_candidate(task, 50.0, 0.5).image_error

    def test_feature_levels_and_switching_are_in_the_loop(self):
        ideal = DesignTask(masks=3)
        panel = SpatialLightModulator(GreyLevels(1), Switching(20e-3, 0.1, "random"))
        coarse = coded_candidate(DesignTask(masks=3, modulator=panel), "focal sweep", 25.0, 0.5, FEW).image_error
        assert coarse > 1.1 * coded_candidate(ideal, "focal sweep", 25.0, 0.5, FEW).image_error

    @pytest.mark.parametrize("weight", [0.3, 1.0])
    def test_smoke_depth_has_a_gradient_too(self, weight):
        task = DesignTask(masks=1, depth_weight=weight)
        few, more = (coded_candidate(task, "Fisher", 40.0, 0.5, steps) for steps in (1, 4))
        assert more.cost < few.cost
        assert 0 < more.depth_error < 12**-0.5
        assert (more.image_error != more.image_error) is (weight == 1)


class TestInitialPhase(BaseTester):
    @pytest.mark.parametrize("start", STARTS)
    def test_cardinality(self, start):
        assert initial_phase(DesignTask(masks=3, mask_size=21), start, 30.0, 0.5).shape == (3, 21, 21)

    def test_feature_the_sweep_brings_its_depths_into_focus(self):
        """Each mask of three is sharpest at its own third of the range of defocus."""
        task = DesignTask(masks=3)
        sweep = initial_phase(task, "focal sweep", 30.0, 0.5)
        for number, phase in enumerate(sweep):
            lens = search_lens(task, mask_of(phase[None]), 30.0, 0.5)
            lo, hi = lens.camera.defocus_range
            middles = [lo + (hi - lo) * (third + 0.5) / 3 for third in range(3)]
            peaks = lens.psf_bank(defocus=middles).psfs.amax((1, 2, 3))
            assert int(peaks.argmax()) == number


class TestRealLens(BaseTester):
    @torch.no_grad()
    def test_feature_cost_is_that_of_places_over_the_field(self):
        """Each place stands for an equal area; the search and the captures see the lens there."""
        task = DesignTask(masks=1, lens="single-50mm", depth_range=(0.5, 0.7))
        assert task.focal_length == pytest.approx(0.05, rel=1e-4)
        heights = [math.hypot(*place) * task.pixel_pitch for place in task.places()]
        assert [round((h / 6.784e-3) ** 2 * 6) for h in heights] == [1, 3, 5]
        lens = search_lens(task, None, 14.0, 0.5)
        cost, error, _ = cost_of(task, lens, 14.0)
        each = [restoration_error(lens.psf_bank(field=[p]).at(0), task.sensor(14.0)) for p in task.places()]
        assert float(error) == pytest.approx(float(torch.stack(each).mean()), rel=1e-4)
        ideal = DesignTask(masks=1, focal_length=task.focal_length, depth_range=(0.5, 0.7))
        assert float(cost) > float(cost_of(ideal, search_lens(ideal, None, 14.0, 0.5), 14.0)[0]) + 0.1

    @pytest.mark.takes_seconds
    def test_feature_masks_and_depth(self):
        task = DesignTask(masks=1, lens="single-50mm", depth_range=(0.5, 0.7), depth_weight=0.5)
        found = coded_candidate(task, "focal sweep", 20.0, 0.5, steps=2)
        assert 0 < found.image_error < 1
        assert 0 < found.depth_error < 1
        optics = candidate_optics(task, found)
        assert optics.lens.name == "single-50mm"
        [scores] = score_candidate(task, found, leaf_scenes(1, 140, task.depth_range))
        assert {"image", "depth"} == set(scores)

    def test_feature_captures_are_scored_at_places_over_the_field(self, monkeypatch):
        """One place alone misleads: without masks the outer one is 3 dB below the inner one."""
        task = DesignTask(lens="single-50mm", depth_range=(0.5, 0.7))
        flat, scenes = flat_candidate(task, 14.0, 0.2), leaf_scenes(1, 140, task.depth_range)
        [over_field] = score_candidate(task, flat, scenes)
        each = []
        for place in task.places():
            monkeypatch.setattr(DesignTask, "places", lambda self, own=place: (own,))
            each += [one["image"] for one in score_candidate(task, flat, scenes)]
        best = [max(one.values()) for one in each]
        assert best[0] > best[2] + 1
        for name, score in over_field["image"].items():
            assert score == pytest.approx(sum(one[name] for one in each) / 3, abs=0.01)

    def test_exception(self):
        with pytest.raises(ValueError, match="lens must be one of"):
            DesignTask(lens="sonnar")
        with pytest.raises(ValueError, match=r"focal_length must be that of the lens .*, 0\.05 m, got 0\.035 m"):
            DesignTask(lens="single-50mm", focal_length=0.035)
