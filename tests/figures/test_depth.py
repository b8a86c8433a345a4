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
