"""All layers in one batch of transforms, against the dense backend in float64, every gradient included."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.render.backends import batched
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.borders import BORDERS
from tests.render.render_tester import RenderTester, render_by
from tests.render.scenes import Bank, make_bank, make_scene

COMPOSITINGS = ("gather", "scatter", "occlusion")
# Of transforms in float64, some 1e-16 of the light; occlusion divides it by as little as 1e-6.
ROUNDING = {"gather": 1e-13, "scatter": 1e-13, "occlusion": 1e-9}


@pytest.fixture(params=["one part", "parts"])
def parts(request, monkeypatch) -> str:
    if request.param == "parts":
        monkeypatch.setattr(batched, "PART_BYTES", 20_000)
    return request.param


class TestBatchedBackend(RenderTester):
    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_equals_dense(self, compositing, border, layers, parts):
        bank = make_bank(light=0.9, veil=True)
        image, defocus = make_scene(bank, batch=3)
        options = {"border": border, "layers": layers}
        atol = ROUNDING[compositing]
        self.assert_equals_dense(BatchedBackend(), image, defocus, bank, compositing, atol, **options)

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("border", ["zero", "valid"])
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_gradcheck_equals_dense(self, compositing, border, layers, parts):
        bank = make_bank(light=0.9, veil=True)
        image, defocus = make_scene(bank)
        options, atol = {"border": border, "layers": layers}, 10 * ROUNDING[compositing]
        self.assert_gradients_equal_dense(BatchedBackend(), image, defocus, bank, compositing, atol, **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_cardinality_one_defocus_map_for_a_batch(self, compositing, parts):
        bank = make_bank(veil=True)
        image, defocus = make_scene(bank, batch=3)
        options, atol = {"border": "reflect", "layers": "linear"}, 10 * ROUNDING[compositing]
        for check in (self.assert_equals_dense, self.assert_gradients_equal_dense):
            check(BatchedBackend(), image, defocus[:1], bank, compositing, atol, **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_cardinality_one_layer(self, compositing):
        bank = make_bank(layers=1)
        image, defocus = make_scene(bank)
        self.assert_equals_dense("batched", image, defocus, bank, compositing, ROUNDING[compositing])

    def test_feature_occlusion_hides_what_is_behind_an_opaque_layer(self):
        """Where the nearest layer is all there is, nothing shines through, and nothing behind has a gradient."""
        bank = make_bank(layers=3, channels=1, size=3)
        image, defocus = torch.rand(1, 1, 8, 8, dtype=torch.float64), torch.full((1, 1, 8, 8), -4.0).double()
        psfs = bank.psfs.clone().requires_grad_()
        coded = render_by("batched", image, defocus, Bank(psfs, bank.defocus), "occlusion")
        coded.sum().backward()
        assert psfs.grad is not None
        assert float(psfs.grad[:2].abs().max()) <= 1e-9
        assert float(psfs.grad[2].abs().max()) > 1e-3

    def test_exception_torch_func_takes_dense_alone(self):
        bank = make_bank()
        image, defocus = make_scene(bank)
        with pytest.raises(ValueError, match=r"method 'batched' does not support this scene: torch\.func"):
            torch.func.grad(lambda x: render_by("batched", x, defocus, bank).sum())(image)
