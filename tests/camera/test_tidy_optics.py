"""The camera as a whole: what light does in it. How it fits into pipelines is tested in test_pipelines*.py."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import DefocusRange, DwellTimes, Fidelity, PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import camera_spectrum, circular_aperture
from kornia_tidy.psf.psf_bank import enclosing_window
from tests.base import BaseTester
from tests.rounding import gamma

SMALL = Fidelity(window=9, layer_spacing=5.0)


class TestLight(BaseTester):
    def test_feature_cameras_share_no_part_by_default(self):
        """What is set on one, as load_state_dict does with take_over=True, would be set on all."""
        one, other = TiDyOptics(), TiDyOptics()
        for name in ("masks", "camera", "modulator", "sensor"):
            assert getattr(one, name) is not getattr(other, name)

    def test_feature_geometric_blur_uses_the_image_distance(self):
        """A thin lens blurs a point to a disc of radius R s' |1/z - 1/z_f|; with f for s' it would be 9 % smaller."""
        camera = ThinLensCamera(50e-3, 12.5e-3, 0.595, 8e-6, depth_range=(0.4, 0.6))
        disc = circular_aperture(92, 2.3 / 92, edges="area")
        fidelity = Fidelity(window=201, layer_spacing=400.0)
        optics = TiDyOptics(
            PixelwiseMask(1, initial="flat"),
            camera,
            None,
            None,
            fidelity,
            spectrum=Spectrum.monochrome(),
            aperture=disc,
        )
        psf = optics.psf_bank().psfs[-1, 0].detach().double()  # at 0.4 m
        lo, hi = 0.0, 100.0
        for _ in range(40):
            middle = (lo + hi) / 2
            inside = float((psf * circular_aperture(201, 1.0, radius=middle, edges="area")).sum())
            lo, hi = (middle, hi) if inside < 0.5 else (lo, middle)
        expected = 6.25e-3 * camera.image_distance * (1 / 0.4 - 1 / 0.595) / 8e-6
        assert lo * math.sqrt(2) == pytest.approx(expected, rel=0.01)

    @pytest.mark.parametrize("layers", ["nearest", "linear", "bandlimited"])
    def test_feature_an_occlusion_capture_is_the_weighted_mean_of_single_masks(self, layers):
        """And not the capture through the mean PSFs, which is what ``occlusion_states="mean"`` takes."""
        masks, shares = PixelwiseMask(3), (3, 1, 2)
        options = {"sensor": None, "color_space": "linear", "compositing": "occlusion"}
        fidelity = SMALL.replace(layers=layers, layer_spacing=2.0)
        optics = TiDyOptics(masks, modulator=DwellTimes(shares), fidelity=fidelity, **options)
        image, depth = torch.rand(1, 3, 40, 44), torch.where(torch.arange(44) < 20, 0.4, 2.0).expand(1, 1, 40, 44)
        single = [
            TiDyOptics(PixelwiseMask(initial=height[None]), fidelity=fidelity, **options)(image, depth).detach()
            for height in masks.heights().detach()
        ]
        expected = sum(share / 6 * own for share, own in zip(shares, single, strict=True))
        coded = optics(image, depth)
        self.assert_close(coded, expected, rtol=0, atol=2e-6)
        through_mean = optics.with_fidelity(fidelity.replace(occlusion_states="mean"))(image, depth)
        error = float((through_mean - coded).detach().abs().max())
        assert 2e-5 < error < 2e-2

    def test_exception_what_hides_has_no_spectrum_of_its_own(self):
        with pytest.raises(ValueError, match="compositing 'occlusion' needs colours without spectra"):
            TiDyOptics(compositing="occlusion", spectrum=camera_spectrum(samples=8, reflectance=True))

    def test_feature_paper_takes_srgb_as_light_and_correlates(self):
        masks = PixelwiseMask(2)
        paper = TiDyOptics(masks, DefocusRange(-10, 10), sensor=None, fidelity="paper")
        assert paper.color_space == "paper"
        image, disparity = torch.rand(1, 3, 40, 44), torch.full((1, 1, 40, 44), 0.75)
        index = paper.defocus_nodes.index(5.0) if 5.0 in paper.defocus_nodes else None
        bank = paper.psf_bank()
        nearest = int((bank.defocus - 5.0).abs().argmin()) if index is None else index
        expected = torch.nn.functional.conv2d(  # torch's conv2d is a correlation
            torch.nn.functional.pad(image, [11] * 4, mode="reflect"), bank.psfs[nearest][:, None], groups=3
        )
        self.assert_close(paper(image, disparity), expected, atol=0, rtol=2 * gamma(23 * 23, torch.float32))

    def test_feature_linear_light_passes_hdr_untouched(self):
        optics = TiDyOptics(sensor=None, color_space="linear", fidelity=SMALL)
        image = torch.full((1, 3, 20, 20), 37.5)
        roundings = 2 * optics.window**2 + 8  # PSFs are divided by their sum, and light is added up over them
        coded = optics(image, torch.ones(1, 1, 20, 20))
        self.assert_close(coded, image, rtol=gamma(roundings, torch.float32), atol=0)

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_learns_where_determinism_is_demanded(self, compositing, device):
        """Torch then refuses operations that have no deterministic form."""
        optics = TiDyOptics(PixelwiseMask(2), sensor=None, compositing=compositing, fidelity=SMALL).to(device)
        image = torch.rand(1, 3, 40, 40, device=device, requires_grad=True)
        depth = (0.3 + torch.rand(1, 1, 40, 40, device=device)).requires_grad_()
        found = []
        before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
        torch.use_deterministic_algorithms(True)
        try:
            for _ in range(2):
                loss = optics(image, depth).square().sum()
                found.append(torch.autograd.grad(loss, [image, depth, *optics.parameters()]))
        finally:
            torch.use_deterministic_algorithms(before[0], warn_only=before[1])
        for first, second in zip(*found, strict=True):
            assert torch.equal(first, second)
            assert float(first.abs().max()) > 0


class TestWindow(BaseTester):
    def test_feature_the_window_is_the_smallest_that_holds_the_share(self):
        optics = TiDyOptics(PixelwiseMask(initial="flat"), fidelity=Fidelity(enclosed_energy=0.9, layer_spacing=20.0))
        wide = TiDyOptics(optics.masks, fidelity=Fidelity(window=65, layer_spacing=20.0, stray_light="discard"))
        psfs = wide.psf_bank().psfs.detach()
        assert abs(optics.window - enclosing_window(psfs, 0.9)) <= 2  # measured with coarser pixels
        assert optics.window < 41

    def test_feature_a_window_too_small_warns_with_numbers(self):
        with pytest.warns(UserWarning, match=r"9 px, holds \d+% of the light where it should hold 80%"):
            TiDyOptics(fidelity=Fidelity(max_window=9))

    @pytest.mark.parametrize("masks", ["flat", "noise"])
    def test_feature_the_window_holds_the_disc_of_the_lens(self, masks):
        """50 mm f/4 at 1 m on pixels of 4 um: a disc of 164 px by rays, which a window of 65 px cut to a fifth."""
        camera = ThinLensCamera(50e-3, focus_distance=torch.tensor(1.0), pixel_pitch=4e-6, f_number=4)
        masks = PixelwiseMask(1, initial=masks, generator=torch.Generator().manual_seed(0))
        optics = TiDyOptics(masks, camera, fidelity=Fidelity(layer_spacing=20.0))
        disc = float(camera.aperture_diameter * camera.image_distance.detach() * (1 / 0.5 - 1) / 4e-6)
        assert disc < optics.window < 1.25 * disc
        assert optics.light_held[0] > 0.95

    def test_feature_a_window_beyond_what_follows_a_lens_still_warns(self):
        camera = ThinLensCamera(50e-3, focus_distance=1.0, pixel_pitch=4e-6, f_number=2)
        with pytest.warns(UserWarning, match="65 px, holds .* or narrow the camera's depth_range"):
            TiDyOptics(PixelwiseMask(1), camera)

    def test_smoke_repr_tells_the_camera(self):
        words = repr(TiDyOptics())
        for part in (
            "f/17.6",
            "0.595 m",
            "psi +20.02 to -20.02",
            "5 learnable masks of 23x23",
            "PSF window",
            "% of the light",
        ):
            assert part in words
