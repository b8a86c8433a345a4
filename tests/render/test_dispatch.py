"""Which backend is taken, what is said about it, and that one asked for by name is the one that runs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kornia_tidy.kernels import gather_ops, occlusion_ops
from kornia_tidy.kernels.build import compiled
from kornia_tidy.render import dispatch, layered_scene
from kornia_tidy.render.compositing import COMPOSITING, render
from kornia_tidy.render.dispatch import BACKENDS, choose, explain
from tests.base import BaseTester
from tests.render.scenes import make_bank, make_scene
from tests.simulated_device import SimulatedDevice

needs_compiler = pytest.mark.skipif(
    any(compiled(source, torch.float32) is None for source in (gather_ops.SOURCE, occlusion_ops.SOURCE)),
    reason="no C compiler on this machine: nothing is rendered in C",
)
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)


def scene_of(compositing="gather", layers=6, psf_size=9, height=40, width=60, **options):
    bank = make_bank(layers, 3, psf_size, dtype=torch.float32, light=0.8, veil=True)
    image, defocus = make_scene(bank, 1, height, width)
    return layered_scene(image, defocus, bank.defocus, bank.psfs, bank.veil, compositing=compositing, **options)


class TestChoose(BaseTester):
    @needs_compiler
    @over_compositing
    def test_feature_processors_take_compiled_code(self, compositing):
        for psf_size in (1, 9, 31):
            assert choose(scene_of(compositing, psf_size=psf_size)).name == "compiled"

    @over_compositing
    def test_feature_processors_without_a_compiler_take_batched(self, compositing, monkeypatch):
        monkeypatch.setattr("kornia_tidy.render.backends.compiled.compiled", lambda source, dtype: None)
        scene = scene_of(compositing)
        assert choose(scene).name == "batched"
        assert explain(scene).objections["compiled"] == "it needs a C compiler (see `kornia-tidy info`)"
        with pytest.raises(ValueError, match=r"method 'compiled' does not support this scene: it needs a C compiler"):
            choose(scene, "compiled")

    @over_compositing
    def test_feature_accelerators_take_batched(self, compositing):
        with SimulatedDevice() as device:
            bank = make_bank(6, 1, 9, dtype=torch.float32)
            tensors = (*make_scene(bank, 2, 40, 60), bank.defocus, bank.psfs)
            assert choose(layered_scene(*map(device.put, tensors), compositing=compositing)).name == "batched"

    @pytest.mark.parametrize("compiler", [pytest.param(True, marks=needs_compiler), False])
    def test_feature_large_psfs_go_densely_where_that_is_faster_and_memory_small(self, compiler, monkeypatch):
        if not compiler:
            monkeypatch.setattr("kornia_tidy.render.backends.compiled.compiled", lambda source, dtype: None)
        scene = scene_of("occlusion", 3, 67, 70, 80)
        assert choose(scene).name == "dense"
        assert choose(scene_of("gather", 3, 67, 70, 80)).name == ("compiled" if compiler else "dense")
        assert choose(scene_of("gather", 3, 17, 70, 80)).name == ("compiled" if compiler else "batched")
        recorded = replace(scene, psfs=scene.psfs.clone().requires_grad_())
        assert choose(recorded).name != "dense"
        with torch.no_grad():
            assert choose(recorded).name == "dense"
        monkeypatch.setattr(dispatch, "LARGEST_PLANE", 8 * scene.image.numel() - 1)
        assert choose(scene).name != "dense"

    @pytest.mark.parametrize("method", ["auto", *BACKENDS])
    @over_compositing
    def test_feature_the_named_backend_renders(self, compositing, method):
        bank = make_bank(6, 3, 9, dtype=torch.float32)
        image, defocus = make_scene(bank, 1, 40, 60)
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=compositing)
        expected = explain(scene).backend if method == "auto" else method
        if (why := BACKENDS[expected].refusal(scene)) is not None:
            pytest.skip(why)
        coded = BACKENDS[expected].render(scene).to(image.dtype)
        assert torch.equal(render(image, defocus, bank, compositing, method=method), coded)

    def test_exception_unknown_method(self):
        bank = make_bank()
        message = f"method must be one of 'auto', {', '.join(map(repr, BACKENDS))}, got 'sparse'"
        with pytest.raises(ValueError, match=message):
            render(*make_scene(bank), bank, method="sparse")

    @pytest.mark.parametrize("method", [name for name in BACKENDS if name != "dense"])
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


class TestExplain(BaseTester):
    @needs_compiler
    def test_smoke_it_says_what_is_chosen_and_what_it_takes(self):
        explanation = explain(scene_of("scatter", psf_size=31))
        lines = str(explanation).splitlines()
        assert lines[0] == "scatter of 1 x 3 channels of 40x60 px, 6 of 6 layers, PSFs of 31x31 px: compiled"
        assert lines[1] == f"  compiled: {explanation.works['compiled']}"
        assert lines[1].startswith("  compiled: windows of 96 px, ")
        assert " operations, " in lines[1]
        assert lines[1].endswith(" MiB")

    def test_feature_every_backend_has_its_work_or_an_objection(self):
        for compositing in COMPOSITING:
            explanation = explain(scene_of(compositing, psf_size=3))
            assert explanation.works.keys() | explanation.objections.keys() == set(BACKENDS)
            assert all(work.operations > 0 and work.memory > 0 for work in explanation.works.values())
