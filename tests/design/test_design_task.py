from __future__ import annotations

import math
from itertools import pairwise

import pytest

from kornia_tidy.design import DesignTask
from kornia_tidy.design.candidates import flat_candidate
from kornia_tidy.sensor import full_well_of
from tests.base import BaseTester


class TestDesignTask(BaseTester):
    @pytest.mark.parametrize(
        ("given", "sentence"),
        [
            ({"focal_length": 50}, r"focal_length must be metres between 1e-05 and 10 \(50 mm is 50e-3\), got 50"),
            ({"pixel_pitch": 8}, "pixel_pitch must be metres between"),
            ({"depth_range": (300, 5000)}, "depths from 300 to 5000 m are all in focus .* if they are millimetres"),
            ({"depth_range": (0.06, 5)}, "depth_range must begin beyond two focal lengths, 0.1 m, got 0.06 m"),
            ({"depth_range": (2, 1)}, "depth_range must be .* with 0 < near < far"),
            ({"electrons": 0}, "electrons must be positive"),
            ({"masks": 0}, "masks must be a whole number from 1 to 64, got 0"),
            ({"full_well": 0}, "full_well must be positive and finite, got 0"),
        ],
    )
    def test_exception_names_the_value_and_what_is_allowed(self, given, sentence):
        with pytest.raises(ValueError, match=sentence):
            DesignTask(**given)

    def test_exception_parts_of_another_type(self):
        with pytest.raises(TypeError, match="modulator must be a modulator such as DwellTimes"):
            DesignTask(modulator=8)
        with pytest.raises(TypeError, match="statistics must be SceneStatistics"):
            DesignTask(statistics=0.3)

    @pytest.mark.parametrize("depth_range", [(0.2975, math.inf), (0.5, 2.0)])
    def test_feature_blur_and_airy_disc_are_equally_wide_at_the_balanced_f_number(self, depth_range):
        """By rays: from the near point through the pupil's edges to the sensor, focused in the middle of the range."""
        task = DesignTask(depth_range=depth_range)
        f_number = task.balanced_f_number
        camera = task.camera(f_number, 0.5)
        image = 1 / (1 / task.focal_length - 1 / depth_range[0])
        blur = camera.aperture_diameter * abs(float(camera.image_distance) / image - 1)
        airy = 2.44 * 530e-9 * float(camera.image_distance) / camera.aperture_diameter
        assert blur == pytest.approx(airy, rel=1e-9)

    @pytest.mark.parametrize("depth_range", [(0.2975, math.inf), (1.2, math.inf), (0.4, 1.0)])
    def test_feature_the_best_flat_lens_in_bright_light_is_near_the_balanced_one(self, depth_range):
        """The geometric estimate is right to within one stop."""
        task = DesignTask(depth_range=depth_range, electrons=1e7, read_noise=0.1)
        stops = [step / 4 for step in range(-8, 9)]
        errors = {stop: flat_candidate(task, task.balanced_f_number * 2**stop, 0.5).image_error for stop in stops}
        assert abs(min(errors, key=lambda stop: errors[stop])) <= 0.5

    def test_feature_the_grid_of_f_numbers_is_in_stops_around_the_balanced_one(self):
        task = DesignTask()
        grid = task.f_numbers()
        assert task.balanced_f_number in grid
        for wider, slower in pairwise(grid):
            assert slower / wider == pytest.approx(math.sqrt(2))

    def test_feature_light_falls_with_the_square_of_the_f_number(self):
        task = DesignTask(electrons=1000, reference_f_number=10)
        assert task.sensor(20.0).full_well == pytest.approx(250)

    def test_feature_the_full_well_limits_the_exposure(self):
        """57,000 electrons at f/17.6 are 1.54 million at f/3.39, more than a pixel of 8 um holds."""
        task = DesignTask()
        assert task.sensor(3.39).full_well == full_well_of(8e-6)
        assert task.sensor(35.2).full_well == 57_000 / 4
        small = DesignTask(full_well=20_000)
        assert small.sensor(17.6).full_well == 20_000
        assert small.sensor(small.saturating_f_number * 1.001).full_well < 20_000
        assert small.noise(5.0) == small.noise(17.6)

    def test_feature_focus_is_a_fraction_of_inverse_depth(self):
        task = DesignTask(depth_range=(0.5, 2.0))
        assert [1 / float(task.camera(20.0, focus).focus_distance) for focus in (0, 0.5, 1)] == pytest.approx(
            [0.5, 1.25, 2.0]
        )
