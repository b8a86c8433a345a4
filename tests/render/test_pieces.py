"""The pieces that a capture is a sum over, against all PSFs at once."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.design.tradeoff.costs import peak_bytes
from kornia_tidy.psf import exact, psf_cache, psf_model
from kornia_tidy.render import pieces
from kornia_tidy.render.dispatch import Rendering
from kornia_tidy.render.pieces import Piece, layer_bytes, pieces_of, render_piece, runs_of
from tests.base import BaseTester

# Layer weights carry a rounding of defocus over the layers' spacing, 1e2 units of the last place; PSFs and transforms
# some more. In float64 that is 1e-13.
ROUNDING = 1e-11
FEW = (3, False)  # layers of a piece, and PSFs are not remembered


def make_optics(layers: str = "linear", stray_light: str = "renormalize", **options) -> TiDyOptics:
    torch.manual_seed(3)
    fidelity = Fidelity(window=7, layers=layers, layer_spacing=4.0, stray_light=stray_light)
    camera = DefocusRange(-20, 20)
    return TiDyOptics(PixelwiseMask(2), camera, fidelity=fidelity, sensor=None, color_space="linear", **options)


def make_scene(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Return light and defocus between -18 and -6 rad, on a layer at -8 rad, and between 4 and 22 rad."""
    torch.manual_seed(4)
    psi = torch.cat([12 * torch.rand(2, 1, 10, 22) - 18, torch.full((2, 1, 2, 22), -8.0)], 2)
    return torch.rand(2, 3, 24, 22, dtype=dtype), torch.cat([psi, 18 * torch.rand(2, 1, 12, 22) + 4], 2).to(dtype)


def fast_optics(budget: int) -> TiDyOptics:
    """Return a 50 mm f/1.4 lens with masks, focused at 3 m: 631 layers."""
    torch.manual_seed(0)
    lens = ThinLensCamera(50e-3, 50e-3 / 1.4, 3.0, 6e-6)
    return TiDyOptics(PixelwiseMask(1), lens, fidelity=Fidelity(window=65), sensor=None, memory_budget=budget)


@pytest.fixture
def few(monkeypatch):
    """Return the pieces of a scene, of few layers each whatever memory is allowed."""

    def found(optics: TiDyOptics, light: Tensor, psi: Tensor) -> list[Piece]:
        with monkeypatch.context() as patch:
            patch.setattr(pieces, "_most_layers", lambda *_: FEW)
            return list(pieces_of(optics.psf_model, light.shape[1], light.dtype, psi, optics.compositing, 1))

    return found


def both(optics: TiDyOptics, light: Tensor, psi: Tensor, parts: list[Piece]) -> tuple[Tensor, Tensor]:
    """Return the irradiance through pieces and through all PSFs at once."""
    whole = pieces_of(optics.psf_model, light.shape[1], light.dtype, psi, optics.compositing)
    layers = optics.fidelity.layers
    rendering = Rendering(optics.compositing, optics.border, layers, optics.fidelity.correlate)
    return tuple(sum(render_piece(light, psi, piece, rendering) for piece in each) for each in (parts, whole))


class TestPieces(BaseTester):
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @pytest.mark.parametrize(("layers", "stray_light"), [("linear", "veil"), ("nearest", "renormalize")])
    @torch.no_grad()
    def test_feature_is_the_whole_bank(self, few, border, compositing, layers, stray_light):
        optics, scene = make_optics(layers, stray_light, compositing=compositing, border=border), make_scene()
        found, expected = both(optics, *scene, few(optics, *scene))
        self.assert_close(found, expected, rtol=0, atol=ROUNDING)

    @torch.no_grad()
    def test_feature_layers_that_the_scene_does_not_hold_are_not_computed(self, few):
        held = [-20, -16, -12], [-12, -8, -4], [4, 8, 12], [12, 16, 20]
        assert [piece.bank().defocus.tolist() for piece in few(make_optics(), *make_scene())] == [
            [float(psi) for psi in nodes] for nodes in held
        ]

    @torch.no_grad()
    def test_feature_occlusion_holds_one_state_at_a_time(self, few):
        optics, scene = make_optics(compositing="occlusion"), make_scene()
        parts = few(optics, *scene)
        found, expected = both(optics, *scene, parts)
        self.assert_close(found, expected, rtol=0, atol=ROUNDING)
        assert [(float(piece.share), piece.keep) for piece in parts] == [(0.5, False)] * 2

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_gradients_are_those_of_the_whole_bank(self, few, compositing):
        optics, (light, psi) = make_optics(compositing=compositing).double(), make_scene()
        leaves = [optics.masks.phase, light.requires_grad_(), psi.requires_grad_()]
        way = torch.randn_like(light)
        captures = both(optics, light, psi, few(optics, light, psi))
        found, expected = (torch.autograd.grad((x * way).sum(), leaves) for x in captures)
        for own, whole in zip(found, expected, strict=True):
            self.assert_close(own, whole, rtol=0, atol=1e3 * ROUNDING * float(whole.abs().max()))

    @given(present=st.lists(st.booleans(), max_size=30), most=st.integers(1, 5))
    def test_property_runs_hold_what_is_present_once(self, present, most):
        runs = runs_of(present, most)
        assert [i for first, stop in runs for i in range(first, stop)] == [i for i, own in enumerate(present) if own]
        assert all(0 < stop - first <= most for first, stop in runs)


class TestBudget(BaseTester):
    @pytest.mark.parametrize("optics", [TiDyOptics(), fast_optics(32 << 20)], ids=["usual", "fast lens, flat scene"])
    def test_feature_what_fits_comes_at_once(self, optics):
        reach = torch.tensor([-9.0, 9.0])
        [piece] = pieces_of(optics.psf_model, 1, torch.float32, reach, "gather", optics.memory_budget)
        assert (piece.span, piece.keep, piece.grid) == (None, True, 1)

    @pytest.mark.parametrize("budget", [64 << 20, 256 << 20])
    def test_feature_pieces_fit_the_budget(self, budget):
        model, reach = fast_optics(budget).psf_model, torch.tensor([-600.0, 600.0])
        psfs, work = layer_bytes(model, 1, torch.float32)
        parts = list(pieces_of(model, 1, torch.float32, reach, "gather", budget))
        nodes = torch.tensor(model.defocus_nodes)
        for piece in parts:
            within = (nodes >= piece.span[0]) & (nodes <= piece.span[1])
            assert not piece.keep
            assert 2 <= int(within.sum()) <= budget // 2 // (psfs + work) + 1  # an open end holds one node more
        assert len(parts) > 1

    @pytest.mark.parametrize("remembered", [False, True])
    @torch.no_grad()
    def test_feature_psfs_and_matrices_are_kept_only_where_they_fit(self, monkeypatch, remembered):
        model = make_optics().psf_model
        monkeypatch.setattr(pieces, "_most_layers", lambda *_: (3, remembered))
        for module in (exact, psf_model):
            monkeypatch.setattr(module, "MEMORY", memory := psf_cache.PSFMemory())
            _ = next(pieces_of(model, 3, torch.float32, torch.tensor([-17.0, -16.5]), budget=1)).bank()
            assert bool(memory._held) == remembered

    @pytest.mark.takes_seconds
    @torch.no_grad()
    def test_feature_a_fast_lens_with_masks_keeps_to_its_budget(self):
        image, budget = torch.rand(1, 1, 48, 64), 24 << 20
        depth = (1 / torch.linspace(1 / 2.9, 1 / 2.1, 48))[:, None].expand(1, 1, 48, 64).contiguous()
        whole, small = fast_optics(1 << 40), fast_optics(budget)
        small(image, torch.full_like(depth, 3.0))  # what is allocated once
        found: list[Tensor] = []
        taken = peak_bytes(lambda: found.append(small(image, depth)), image.device)
        assert taken < budget < peak_bytes(lambda: found.append(whole(image, depth)), image.device)
        # In float32 defocus of 300 rad over 2 rad between layers: 150 units of the last place, and those of transforms.
        self.assert_close(found[0], found[1], rtol=0, atol=1e3 * torch.finfo(torch.float32).eps)
