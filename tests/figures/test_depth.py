from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy import ThinLensCamera
from kornia_tidy.figures.depth import depth_at, depth_ticks, draw_depth
from tests.base import BaseTester


class TestDrawDepth(BaseTester):
    def test_feature_colours_are_linear_in_inverse_depth_and_end_with_the_cameras_range(self):
        camera = ThinLensCamera()
        near, far = camera.depth_range
        middle = 2 / (1 / near + 1 / far)
        figure = draw_depth(torch.tensor([near / 2, near, middle, far]).expand(1, 3, 4), camera)
        np.testing.assert_allclose(figure.axes[0].images[0].get_array()[0], [1, 1, 0.5, 0], atol=1e-6)

    def test_feature_the_less_is_known_the_greyer(self):
        """By the share of the variance of a depth of which nothing is known, 1/12."""
        deviation = torch.tensor([0.0, 1 / 48**0.5, 1 / 12**0.5, 0.5]).expand(1, 3, 4)
        figure = draw_depth(torch.full((1, 3, 4), 0.6), ThinLensCamera(), deviation)
        np.testing.assert_allclose(figure.axes[0].images[1].get_alpha()[0], [0, 0.25, 1, 1], atol=1e-6)
        assert [text.get_text() for text in figure.texts] == ["grey: unknown"]

    def test_feature_the_bar_names_depths_far_enough_apart(self):
        places = [place for place, _ in depth_ticks(ThinLensCamera())]
        assert min(np.diff(sorted(places))) > 0.12
        assert {0.0, 1.0} <= {round(place, 9) for place in places}


class TestDepthAt(BaseTester):
    @pytest.mark.parametrize("depth", [0.3, 0.595, 2.0, math.inf])
    def test_feature_inverts_the_cameras_defocus(self, depth):
        camera = ThinLensCamera()
        defocus = float(camera.defocus(torch.tensor(depth, dtype=torch.float64)))
        assert depth_at(defocus, camera) == pytest.approx(depth, rel=1e-9)

    @pytest.mark.parametrize("focus", [0.3, 0.99167, 20.0])
    @pytest.mark.parametrize("roundings", [-2, 0, 2])
    def test_feature_infinity_is_found_in_float32(self, focus, roundings):
        """A bank's defocus is a float32, a rounding or two off; depths of kilometres are not taken for infinite."""
        camera = ThinLensCamera(0.05, 0.05 / 23.966, focus)
        defocus = np.float32(camera.defocus(torch.tensor(math.inf, dtype=torch.float64)))
        for _ in range(abs(roundings)):
            defocus = np.nextafter(defocus, np.float32(np.sign(roundings) * np.inf))
        assert math.isinf(depth_at(float(defocus), camera))
        kilometres = float(camera.defocus(torch.tensor(5000.0, dtype=torch.float64)))
        assert depth_at(kilometres, camera) == pytest.approx(5000, rel=1e-6)
