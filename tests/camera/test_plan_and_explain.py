"""Tests of what a camera says before a capture: the backend that renders a scene."""

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.render import dispatch, render
from tests.base import BaseTester


def _scene(side=96):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, side, side, generator=generator), 0.3 + torch.rand(2, 1, side, side, generator=generator)


class TestExplain(BaseTester):
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_the_capture_is_that_of_the_backend_it_names(self, compositing):
        """To the last bit, in which backends differ."""
        optics = TiDyOptics(
            PixelwiseMask(1), fidelity=Fidelity(window=23), compositing=compositing, color_space="linear", sensor=None
        )
        image, depth = _scene()
        explanation, psi = optics.explain(image, depth), optics.camera.defocus(depth)
        assert set(explanation.works) | set(explanation.objections) == set(dispatch.BACKENDS)
        assert str(explanation).startswith(f"{explanation.scene}: {explanation.backend}")
        with torch.no_grad():
            bank = optics.psf_model.scene_bank(3, torch.float32, psi)
            named = {name: render(image, psi, bank, compositing, method=name) for name in explanation.works}
            assert torch.equal(optics(image, depth), named[explanation.backend])

    def test_feature_states_that_are_rendered_one_by_one_are_pieces(self):
        options = {"fidelity": Fidelity(window=9), "sensor": None}
        image, depth = _scene()
        cameras = (TiDyOptics(PixelwiseMask(3), compositing=way, **options) for way in ("occlusion", "gather"))
        hiding, other = (optics.explain(image, depth).scene for optics in cameras)
        assert hiding.endswith(", the first of 3 pieces")
        assert "pieces" not in other

    def test_cardinality_images_without_a_batch(self):
        optics = TiDyOptics(PixelwiseMask(1), fidelity=Fidelity(window=9))
        image, depth = _scene()
        assert "1 x 3 channels of 96x96 px" in optics.explain(image[0], depth[0]).scene
        assert "2 x 3 channels of 96x96 px" in optics.explain(image, depth).scene

    def test_exception_of_no_image(self):
        with pytest.raises(ValueError, match="an explanation needs at least one image"):
            TiDyOptics().explain(torch.rand(0, 3, 8, 8), torch.rand(0, 1, 8, 8))
