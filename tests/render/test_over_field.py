"""PSFs over the field: tiles in C against the definition by whole planes, and against cells of torch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kornia_tidy.psf import FieldBank
from kornia_tidy.psf.field import Field
from kornia_tidy.render import layered_scene, over_field, render
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.dispatch import BACKENDS, Rendering, explain, render_layers
from kornia_tidy.render.over_field import render_over_field
from tests.base import BaseTester
from tests.kernels.operator_tester import needs_compiler

SIZE = (70, 90)


def bank_over(field: Field, dtype=torch.float64, *, veil: bool = False) -> FieldBank:
    """PSFs of 3 layers and 2 channels that change smoothly from node to node."""
    generator = torch.Generator().manual_seed(7)
    parts = torch.rand(3, 3, 2, 9, 9, generator=generator, dtype=torch.float64)
    places = torch.tensor(field.points, dtype=torch.float64) / 50
    psfs = parts[0] + torch.einsum("fi,idcyx->fdcyx", places, 0.3 * parts[1:])
    energy = psfs.sum((-2, -1))
    light = 0.5 + 0.5 * torch.rand(energy.shape, generator=generator, dtype=torch.float64)
    psfs = psfs / energy[..., None, None] * light[..., None, None]
    nodes = torch.tensor([-4.0, 1.0, 5.0], dtype=torch.float64)
    strayed = 0.1 * light if veil else None
    given = psfs, nodes, torch.tensor(field.points, dtype=torch.float64), torch.ones_like(light), light, strayed
    return FieldBank(*(x if x is None else x.to(dtype) for x in given))


def scene_of(dtype=torch.float64, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(8)
    light = torch.rand(batch, 2, *SIZE, generator=generator, dtype=torch.float64)
    coarse = torch.rand(1, 1, 7, 9, generator=generator, dtype=torch.float64)
    return light.to(dtype), (10 * coarse.repeat_interleave(10, 2).repeat_interleave(10, 3) - 5).to(dtype)


@needs_compiler
class TestRenderOverField(BaseTester):
    @pytest.mark.parametrize("nodes", [(3, 2), (1, 3), (2, 1)])
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_tiles_equal_the_sum_over_nodes(self, compositing, border, nodes):
        field = Field(SIZE, nodes, cell=20, still=20 if border == "valid" else 0)
        (light, defocus), bank = scene_of(), bright(bank_over(field))
        given = light, defocus, bank.defocus, bank.psfs, None
        how = Rendering(compositing, border, correlate=border == "zero")
        tiles, whole = (render_layers(*given, how, name, field) for name in ("compiled", "dense"))
        self.assert_close(tiles, whole, rtol=0, atol=1e-13)

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_feature_gradients_equal_those_of_the_sum_over_nodes(self, compositing, layers):
        field = Field(SIZE, (3, 2), origin=(0, 0), cell=24)
        bank, gradient = bank_over(field), torch.randn(2, 2, *SIZE, dtype=torch.float64)
        leaves = [x.clone().requires_grad_() for x in (*scene_of(), bank.psfs)]
        wanted = leaves if layers == "linear" else leaves[::2]
        found = []
        for method in ("compiled", "dense"):
            given = *leaves[:2], bank.defocus, leaves[2], None
            seen = render_layers(*given, Rendering(compositing, "reflect", layers), method, field)
            found.append(torch.autograd.grad(seen, wanted, gradient))
        for own, expected in zip(*found, strict=True):
            self.assert_close(own, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("border", ["reflect", "zero"])
    def test_feature_gradients_behind_what_hides_equal_those_of_the_sum_over_nodes(self, layers, border):
        field = Field(SIZE, (3, 2))
        bank, gradient = bright(bank_over(field)), torch.randn(2, 2, *SIZE, dtype=torch.float64)
        (light, defocus), found = scene_of(), []
        leaves = light.requires_grad_(), bank.psfs.requires_grad_()
        for method in ("compiled", "dense"):
            how = Rendering("occlusion", border, layers)
            seen = render_layers(light, defocus, bank.defocus, bank.psfs, None, how, method, field)
            found.append(torch.autograd.grad(seen, leaves, gradient))
        for own, expected in zip(*found, strict=True):
            self.assert_close(own, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))

    @pytest.mark.parametrize("border", ["reflect", "zero"])
    def test_feature_light_and_defocus_have_gradients_behind_what_hides(self, border):
        """By cells: with one node they see what tiles see."""
        field = Field(SIZE, (1, 1))
        bank = bright(bank_over(field))
        leaves, rendering = [x.requires_grad_() for x in scene_of()], Rendering("occlusion", border)
        seen = render_over_field(*leaves, bank, field, rendering)
        given = *leaves, bank.defocus, bank.with_all_light().psfs, None
        expected = render_layers(*given, rendering, "compiled", field)
        self.assert_close(seen, expected, rtol=0, atol=1e-6)  # the divisors have another EPSILON
        for one, other in zip(*(torch.autograd.grad(x.square().sum(), leaves) for x in (seen, expected)), strict=True):
            self.assert_close(one, other, rtol=0, atol=1e-4 * float(other.abs().max()))

    @pytest.mark.parametrize("border", ["reflect", "valid", "zero"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_feature_cells_of_torch_see_the_same(self, compositing, border, monkeypatch):
        """PSFs that are linear over the field are exact to first order: tiles and cells of any size agree."""
        field = Field(SIZE, (2, 2), origin=(0, 0), cell=32)
        (light, defocus), bank = scene_of(), bank_over(field, veil=True)
        bank = replace(bank, psfs=_without_product(bank.psfs), veil=_without_product(bank.veil))
        tiles = render_over_field(light, defocus, bank, field, Rendering(compositing, border))
        monkeypatch.setattr(over_field, "_is_compiled", lambda *_: False)
        cells = render_over_field(light, defocus, bank, field, Rendering(compositing, border))
        self.assert_close(tiles, cells, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("border", ["reflect", "valid", "zero"])
    def test_feature_cells_of_torch_see_the_same_behind_what_hides(self, border, monkeypatch):
        """Also where windows hold other shares of the light at each node."""
        field = Field(SIZE, (2, 2), cell=32)
        (light, defocus), bank = scene_of(), bank_over(field)
        psfs = _without_product(bank.psfs)
        psfs = psfs - psfs.min() + 1e-3
        held = torch.tensor([0.9, 0.7, 1.0, 0.8], dtype=torch.float64).view(4, 1, 1, 1, 1)
        bank = replace(bank, psfs=held * psfs, light=psfs.sum((-2, -1)))
        tiles = render_over_field(light, defocus, bank, field, Rendering("occlusion", border))
        monkeypatch.setattr(over_field, "_is_compiled", lambda *_: False)
        cells = render_over_field(light, defocus, bank, field, Rendering("occlusion", border))
        self.assert_close(tiles, cells, rtol=0, atol=1e-6)

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_parts_of_a_picture_are_those_of_the_whole(self, compositing):
        field = Field(SIZE, (3, 2), cell=25)
        (light, defocus), bank = scene_of(), bright(bank_over(field))
        whole = render_over_field(light, defocus, bank, field, Rendering(compositing, "valid"))
        part = light[..., 13:60, 7:], defocus[..., 13:60, 7:]
        own = render_over_field(*part, bank, field.moved(13, 7), Rendering(compositing, "valid"))
        self.assert_close(own, whole[..., 13:52, 7:], rtol=0, atol=1e-13)

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_gradcheck_of_gradients(self, compositing):
        """Of 8 x 16 pixels, which occlusion in C takes."""
        field = Field((8, 16), (2, 2))
        bank = bright(bank_over(field))
        light = torch.rand(1, 2, 8, 16, dtype=torch.float64, requires_grad=True)
        psfs = bank.psfs[..., 3:6, 3:6].clone().requires_grad_()
        defocus = torch.linspace(-3.5, 4.5, 128, dtype=torch.float64).view(1, 1, 8, 16)
        how = Rendering(compositing, "reflect")

        def render(light: torch.Tensor, psfs: torch.Tensor) -> torch.Tensor:
            return render_layers(light, defocus, bank.defocus, psfs, None, how, field=field)

        assert torch.autograd.gradcheck(render, (light, psfs), fast_mode=True)
        assert torch.autograd.gradgradcheck(render, (light, psfs), fast_mode=True)

    def test_feature_the_work_is_counted(self):
        """Of small tiles and of several terms for each layer in them."""
        (light, defocus), field = scene_of(), Field(SIZE, (3, 2), cell=32)
        bank = bank_over(field)
        axis = layered_scene(light, defocus, bank.defocus, bank.psfs[0])
        given = light, defocus, bank.defocus, bank.psfs
        works = [BACKENDS["compiled"].work(axis)]
        works += [BACKENDS["compiled"].work(layered_scene(*given, field=Field(SIZE, (3, 2), cell=c))) for c in (32, 16)]
        assert works[0].operations < 1.5 * works[0].operations < works[1].operations < works[2].operations
        for compositing in ("gather", "occlusion"):
            fields = None, Field(SIZE, (3, 2), still=128), Field(SIZE, (3, 2))
            scenes = (
                layered_scene(*given[:3], bank.psfs if own else bank.psfs[0], compositing=compositing, field=own)
                for own in fields
            )
            axis, still, moving = (BACKENDS["compiled"].work(x).operations for x in scenes)
            assert axis < still < moving
        told = str(explain(layered_scene(*given, field=field)))
        assert "3 of 3 layers, PSFs of 9x9 px at 3x2 places over the picture: compiled" in told
        assert "batched: PSFs that vary over the picture are rendered cell by cell" in told

    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_feature_one_node_costs_what_the_axis_does(self, compositing):
        (light, defocus), field = scene_of(), Field(SIZE, (1, 1))
        bank, rendering = bank_over(field), Rendering(compositing, "reflect")
        own = render_over_field(light, defocus, bank, field, rendering)
        assert torch.equal(own, render(light, defocus, bank.at(0), compositing))

    def test_exception_backends_of_one_psf(self):
        field = Field(SIZE, (2, 2))
        (light, defocus), bank = scene_of(), bank_over(field)
        given = light, defocus, bank.defocus, bank.psfs, None
        for compositing in ("gather", "occlusion"):
            with pytest.raises(ValueError, match=r"method 'batched' does not .* vary over the picture .*cell by cell"):
                render_layers(*given, Rendering(compositing, "reflect"), "batched", field)


def bright(bank: FieldBank) -> FieldBank:
    """The bank with PSFs above zero everywhere, as occlusion needs them."""
    return replace(bank, psfs=bank.psfs - bank.psfs.min() + 1e-3)


def _without_product(values: torch.Tensor) -> torch.Tensor:
    """Values at 2 x 2 nodes without the term that is a product of row and column."""
    values = values.clone()
    values[3] = values[1] + values[2] - values[0]
    return values
