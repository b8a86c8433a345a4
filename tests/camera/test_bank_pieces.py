"""PSF banks in pieces against whole banks, and their memory."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.camera.bank_pieces import BankPieces, image_budget, layer_bytes, pieces_for, render_pieces, runs_of
from kornia_tidy.camera.samples import read_sample
from kornia_tidy.psf import exact
from kornia_tidy.tradeoff.costs import peak_bytes
from tests.base import BaseTester

# Layer weights carry a rounding of defocus over the layers' spacing, 1e2 units of the last place; PSFs and transforms
# some more. In float64 that is 1e-13.
ROUNDING = 1e-11


class Asked(BankPieces):
    """Pieces that note which defocus they were asked for."""

    def banks(self, defocus, state=None):
        found = super().banks(defocus, state)
        REACHES.append((found[0][1].defocus.tolist(), state))
        return found


REACHES: list[tuple[list[float], int | None]] = []


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


def both(optics: TiDyOptics, light: Tensor, psi: Tensor, most_layers: int = 3) -> tuple[Tensor, Tensor]:
    """Return the irradiance through pieces and through the whole bank."""
    REACHES.clear()
    pieces = Asked(optics.psf_model, light.shape[1], light.dtype, most_layers, remembered=False)
    each = optics.compositing == "occlusion"
    banks = optics.psf_model.scene_banks(light.shape[1], light.dtype, psi, each)
    border = optics.border
    return render_pieces(light, psi, pieces, optics, border), optics.render(light, psi, banks, border)


def fast_optics(budget: int) -> TiDyOptics:
    """Return a 50 mm f/1.4 lens with masks, focused at 3 m: 631 layers."""
    torch.manual_seed(0)
    lens = ThinLensCamera(50e-3, 50e-3 / 1.4, 3.0, 6e-6)
    return TiDyOptics(PixelwiseMask(1), lens, fidelity=Fidelity(window=65), sensor=None, memory_budget=budget)


class TestRenderPieces(BaseTester):
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @pytest.mark.parametrize(("layers", "stray_light"), [("linear", "veil"), ("nearest", "renormalize")])
    @torch.no_grad()
    def test_feature_is_the_whole_bank(self, border, compositing, layers, stray_light):
        optics = make_optics(layers, stray_light, compositing=compositing, border=border)
        found, expected = both(optics, *make_scene())
        self.assert_close(found, expected, rtol=0, atol=ROUNDING)

    @torch.no_grad()
    def test_feature_layers_that_the_scene_does_not_hold_are_not_computed(self):
        both(make_optics(), *make_scene())
        held = [-20, -16, -12], [-12, -8, -4], [4, 8, 12], [12, 16, 20]
        assert [nodes for nodes, _ in REACHES] == [[float(psi) for psi in nodes] for nodes in held]

    @torch.no_grad()
    def test_feature_occlusion_holds_one_state_at_a_time(self):
        found, expected = both(make_optics(compositing="occlusion"), *make_scene())
        self.assert_close(found, expected, rtol=0, atol=ROUNDING)
        assert [state for _, state in REACHES] == [0, 1]

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_gradients_are_those_of_the_whole_bank(self, compositing):
        optics, (light, psi) = make_optics(compositing=compositing).double(), make_scene()
        leaves = [optics.masks.phase, light.requires_grad_(), psi.requires_grad_()]
        way = torch.randn_like(light)
        found, expected = (torch.autograd.grad((x * way).sum(), leaves) for x in both(optics, light, psi))
        for own, whole in zip(found, expected, strict=True):
            self.assert_close(own, whole, rtol=0, atol=1e3 * ROUNDING * float(whole.abs().max()))

    @torch.no_grad()
    def test_feature_one_depth_map_serves_the_batch(self):
        light, psi = make_scene()
        found, expected = both(make_optics(), light, psi[:1])
        self.assert_close(found, expected, rtol=0, atol=ROUNDING)


class TestPiecesFor(BaseTester):
    def test_feature_usual_cameras_have_one_bank(self):
        optics = TiDyOptics()
        assert pieces_for(optics, 3, torch.float32, torch.tensor([-20.0, 20.0])) is None
        assert pieces_for(fast_optics(32 << 20), 1, torch.float32, torch.tensor([-9.0, 9.0])) is None

    def test_feature_what_is_remembered_fits_the_budget(self):
        reach = torch.tensor([-600.0, 600.0])
        psfs, work = layer_bytes(fast_optics(1).psf_model, 1, torch.float32)
        for budget in (64 << 20, 256 << 20):
            pieces = pieces_for(fast_optics(budget), 1, torch.float32, reach)
            assert pieces.remembered == (601 * psfs <= budget // 2)
            assert 2 <= pieces.most_layers <= budget // 2 // (psfs + work)

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

    def test_feature_image_and_psfs_share_the_budget(self):
        """631 layers of at most 2 MiB want more than half of 64 MiB, the 11 layers of 7 px do not."""
        image, depth = torch.rand(1, 1, 1024, 1024), torch.full((1, 1, 1024, 1024), 0.5)
        for optics, share in ((fast_optics(64 << 20), 2), (make_optics(memory_budget=64 << 20), 1)):
            assert image_budget(optics, read_sample(image, depth, optics)) == (64 << 20) // share

    @pytest.mark.parametrize("remembered", [False, True])
    @torch.no_grad()
    def test_feature_psfs_and_matrices_are_kept_only_where_they_fit(self, remembered):
        model = make_optics().psf_model
        before = list(exact._CACHE)
        BankPieces(model, 3, torch.float32, 3, remembered).banks(torch.tensor([-17.0, -16.5]))
        assert bool(model._memories) == remembered
        assert (list(exact._CACHE) != before) == remembered

    @given(present=st.lists(st.booleans(), max_size=30), most=st.integers(1, 5))
    def test_property_runs_hold_what_is_present_once(self, present, most):
        runs = runs_of(present, most)
        assert [i for first, stop in runs for i in range(first, stop)] == [i for i, own in enumerate(present) if own]
        assert all(0 < stop - first <= most for first, stop in runs)
