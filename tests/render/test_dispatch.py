"""Which backend is taken, what is said about it, and that one asked for by name is the one that runs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kornia_tidy.kernels.build import compiled
from kornia_tidy.render.backends import direct, direct_occlusion
from kornia_tidy.render.compositing import COMPOSITING, render
from kornia_tidy.render.cost_model import seconds_of
from kornia_tidy.render.cost_profile import EPYC
from kornia_tidy.render.dispatch import (
    BACKENDS,
    LARGEST_PLANE,
    METHODS,
    NAMED,
    choose,
    explain,
    memory_objection,
    render_scene,
)
from kornia_tidy.render.scene import layered_scene
from tests.base import BaseTester
from tests.render.scenes import make_bank, make_scene

needs_compiler = pytest.mark.skipif(
    any(compiled(source, torch.float32) is None for source in (direct.SOURCE, direct_occlusion.SOURCE)),
    reason="no C compiler on this machine: nothing is rendered directly",
)
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)


def scene_of(compositing="gather", layers=6, psf_size=9, height=40, width=60, **options):
    bank = make_bank(layers, 3, psf_size, dtype=torch.float32, light=0.8, veil=True)
    image, defocus = make_scene(bank, 1, height, width)
    return layered_scene(image, defocus, bank.defocus, bank.psfs, bank.veil, compositing=compositing, **options)


class TestChoose(BaseTester):
    @over_compositing
    def test_smoke_auto_takes_the_least_time_of_those_that_support_the_scene(self, compositing):
        for psf_size in (3, 9, 31):
            scene = scene_of(compositing, psf_size=psf_size)
            explanation = explain(scene)
            assert choose(scene).name == explanation.backend == min(explanation.seconds, key=explanation.seconds.get)

    @over_compositing
    def test_feature_a_lower_bound_of_the_time_is_one(self, compositing):
        """Of scenes of one layer and of noise, however large the PSFs are."""
        for psf_size in (1, 9, 31):
            for layers in (1, 6):
                scene = scene_of(compositing, layers, psf_size, 80, 120)
                for backend in BACKENDS.values():
                    if backend.refusal(scene) is None:
                        own = seconds_of(backend.work(scene), EPYC)
                        for bound in backend.bounds(scene):
                            assert 0 <= seconds_of(bound, EPYC) <= own * (1 + 1e-6)

    @pytest.mark.parametrize("method", METHODS)
    @over_compositing
    def test_feature_the_named_backend_renders(self, compositing, method):
        bank = make_bank(6, 3, 9, dtype=torch.float32)
        image, defocus = make_scene(bank, 1, 40, 60)
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=compositing)
        expected = explain(scene).backend if method == "auto" else method
        if (why := NAMED[expected].refusal(scene)) is not None:
            pytest.skip(why)
        coded = render_scene(scene, NAMED[expected])
        assert torch.equal(render(image, defocus, bank, compositing, method=method), coded)

    def test_exception_unknown_method(self):
        bank = make_bank()
        message = "method must be one of 'auto', 'direct', 'overlap', 'tiled', 'dense', 'batched', got 'sparse'"
        with pytest.raises(ValueError, match=message):
            render(*make_scene(bank), bank, method="sparse")

    @pytest.mark.parametrize("method", ["direct", "overlap", "tiled"])
    @over_compositing
    def test_exception_a_transform_of_torch_needs_dense(self, compositing, method):
        bank = make_bank(3, 1, 3)
        image, defocus = make_scene(bank, 1, 40, 40)

        def total(image, method):
            return render(image, defocus, bank, compositing, method=method).sum()

        message = f"method '{method}' does not support this scene: torch.func and .* plain operations"
        with pytest.raises(ValueError, match=message):
            torch.func.grad(total)(image, method)
        self.assert_close(torch.func.grad(total)(image, "auto"), torch.func.grad(total)(image, "dense"), rtol=0, atol=0)

    def test_feature_auto_keeps_its_memory_small(self):
        """Dense is passed over where gradients are wanted, and for large images."""
        scene = scene_of("scatter", 2, 31, 32, 32)
        assert memory_objection(scene) is None
        recorded = replace(scene, psfs=scene.psfs.clone().requires_grad_(), grids={})
        assert choose(recorded).name != "dense"
        assert "a spectrum for each layer" in explain(recorded).objections["dense"]
        with torch.no_grad():
            assert memory_objection(recorded) is None
        large = scene_of("scatter", 1, 1, LARGEST_PLANE // 12 // 2048 + 1, 2048)
        assert "a dozen planes" in explain(large).objections["dense"]
        assert choose(large).name != "dense"

    def test_feature_a_choice_is_remembered_for_the_same_layers_and_for_no_others(self):
        """With the tiles, which take as long to choose as a small image to render."""
        flat, nodes = torch.zeros(1, 1, 200, 300), torch.arange(20.0)
        ramp = torch.linspace(0, 19, 300).expand(flat.shape)
        image = torch.rand(1, 1, 200, 300)
        psfs = torch.rand(20, 1, 23, 23).requires_grad_()  # dense is no choice, whose time needs no tiles
        sizes = []
        for psi in (flat, ramp, flat):
            first, again = (
                layered_scene(image, psi, nodes, psfs, compositing="scatter", layers="nearest") for _ in range(2)
            )
            assert choose(first) is choose(again)
            assert first.grids == again.grids
            sizes.append([grid.size for grid in first.grids.values()])
            assert torch.equal(render_scene(first), render_scene(again))
        assert all(sizes)
        assert sizes[0] == sizes[2] != sizes[1]

    def test_feature_dense_is_taken_where_psfs_are_as_large_as_the_image(self):
        """Tiles would each hold all layers and be as large as the image."""
        assert choose(scene_of("scatter", 6, 63, 64, 64)).name == "dense"

    @needs_compiler
    @over_compositing
    def test_feature_backends_agree(self, compositing):
        scene = scene_of(compositing)
        coded = [render_scene(scene, b).double() for b in BACKENDS.values() if b.refusal(scene) is None]
        assert len(coded) == {"gather": 4, "scatter": 3, "occlusion": 3}[compositing]
        for other in coded[1:]:
            self.assert_close(other, coded[0], rtol=0, atol=2e-5)


class TestExplain(BaseTester):
    def test_smoke_it_says_what_is_chosen_and_why(self):
        scene = scene_of("scatter", psf_size=31)
        explanation = explain(scene)
        lines = str(explanation).splitlines()
        assert lines[0].startswith("scatter of 1 x 3 channels of 40x60 px, 6 of 6 layers, PSFs of 31x31 px, ")
        assert lines[0].endswith(f": {explanation.backend}")
        assert lines[1].startswith(f"  {explanation.backend}: about ")
        assert "  direct: direct convolution gathers light and does not scatter it" in lines

    def test_feature_every_backend_has_a_time_or_an_objection(self):
        for compositing in COMPOSITING:
            explanation = explain(scene_of(compositing))
            assert explanation.seconds.keys() | explanation.objections.keys() == set(BACKENDS)
            assert all(seconds > 0 for seconds in explanation.seconds.values())
