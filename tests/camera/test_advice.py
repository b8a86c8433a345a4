"""Tests of what a camera says before a capture: the backend that renders a scene."""

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.render import dispatch
from tests.base import BaseTester


def _scene(side=96):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, side, side, generator=generator), 0.3 + torch.rand(2, 1, side, side, generator=generator)


class TestExplain(BaseTester):
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_it_names_the_backend_that_renders_the_capture(self, compositing, monkeypatch):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=Fidelity(window=23), compositing=compositing, sensor=None)
        image, depth = _scene()
        explanation, taken, choose = optics.explain(image, depth), [], dispatch.choose

        def choose_and_note(*arguments):
            taken.append(choose(*arguments))
            return taken[-1]

        monkeypatch.setattr(dispatch, "choose", choose_and_note)
        with torch.no_grad():
            optics(image, depth)
        assert {backend.name for backend in taken} == {explanation.backend}
        assert set(explanation.seconds) | set(explanation.objections) == set(dispatch.BACKENDS)
        assert explanation.backend in str(explanation)

    def test_cardinality_images_without_a_batch(self):
        optics = TiDyOptics(PixelwiseMask(1), fidelity=Fidelity(window=9))
        image, depth = _scene()
        assert "1 x 3 channels of 96x96 px" in optics.explain(image[0], depth[0]).scene
        assert "2 x 3 channels of 96x96 px" in optics.explain(image, depth).scene

    def test_exception_of_no_image(self):
        with pytest.raises(ValueError, match="an explanation needs at least one image"):
            TiDyOptics().explain(torch.rand(0, 3, 8, 8), torch.rand(0, 1, 8, 8))
