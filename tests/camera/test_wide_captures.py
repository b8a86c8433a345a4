"""Captures through ordinary fast lenses, against exact PSFs of every depth."""

import math

import pytest
import torch

from kornia_tidy import PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import REFERENCE_WAVELENGTH, annular_aperture
from kornia_tidy.psf import exact_psf_bank
from kornia_tidy.psf.wide_blur import GRID_ERROR, LAYER_ERROR, RAY_TOLERANCE
from kornia_tidy.render import gather
from kornia_tidy.render.dispatch import Rendering
from kornia_tidy.render.pieces import pieces_of, render_piece
from tests.base import BaseTester
from tests.polygons import polygon_aperture
from tests.render.test_coarse_gather import light

ERROR = math.hypot(LAYER_ERROR, GRID_ERROR, RAY_TOLERANCE)  # of a photograph
APERTURES = {
    "disc": None,
    "ring": annular_aperture(23, 0.1, 0.5),
    "thin ring": annular_aperture(23, 0.1, 0.8),
    "triangle": polygon_aperture(23, 0.1, 3),
    "pixels": (torch.rand(23, 23, generator=torch.Generator().manual_seed(0)) > 0.5).double(),
}


def fast_camera(f_number: float = 2.8, focus: float = 2.0, **options) -> TiDyOptics:
    lens = ThinLensCamera(50e-3, 50e-3 / f_number, focus, 6e-6)
    options = {"sensor": None, "color_space": "linear", **options}
    return TiDyOptics(PixelwiseMask(1, initial="flat"), lens, **options)


def stairs(size: int = 128) -> torch.Tensor:
    """Depths of 1.6, 1.95, 2.3 and 15 m in strips; none of them has a layer of its own."""
    return torch.tensor([1.6, 1.95, 2.3, 15.0]).repeat_interleave(size // 4).expand(1, 1, size, size)


class TestWideCaptures(BaseTester):
    @torch.no_grad()
    def test_feature_captures_agree_with_exact_psfs_of_each_depth(self):
        optics, image, depth = fast_camera(), light(128), stairs()
        psi = optics.camera.defocus(depth)
        nodes = sorted(psi.unique().tolist())
        psfs = exact_psf_bank(
            torch.zeros(1, 23, 23), torch.ones(1), optics.pupil, Spectrum.monochrome(), [1.0], nodes,
            float(optics.psf_model.pixel_step), 101, 1e-2,
        ).psfs  # fmt: skip
        psfs = psfs / psfs.sum((2, 3), keepdim=True)
        exact = gather(image, psi, psi.new_tensor(nodes), psfs, layers="nearest")
        error = float((optics(image, depth) - exact).square().mean().sqrt())
        assert error < 1.3 * ERROR

    def test_feature_gradients_are_those_of_the_capture(self):
        optics = fast_camera()
        optics.masks.requires_grad_(False)
        image, depth = light(64, torch.float64), stairs(64).double().clone()
        image.requires_grad_()
        depth.requires_grad_()
        torch.manual_seed(5)
        weight = torch.randn(1, 1, 64, 64, dtype=torch.float64)
        (optics(image, depth) * weight).sum().backward()
        for x, step in ((image, 1e-2), (depth, 1e-6)):
            way = torch.rand_like(x) * step
            with torch.no_grad():
                a, b = [way, 0] if x is image else [0, way]
                ahead, back = ((optics(image + s * a, depth + s * b) * weight).sum() for s in (1, -1))
                self.assert_close((x.grad * way).sum(), (ahead - back) / 2, rtol=2e-2, atol=0)

    def test_feature_gradients_reach_a_flat_mask_and_values_do_not_change(self):
        optics, image = fast_camera(2.8), light(64)
        depth = torch.full((1, 1, 64, 64), 1.9)
        coded = optics(image, depth)
        with torch.no_grad():
            assert torch.equal(optics(image, depth), coded)
        coded.square().mean().backward()
        assert float(optics.masks.phase.grad.abs().max()) > 0

    def test_exception_gradients_of_masks_name_the_width_and_each_remedy_works(self):
        optics, image = fast_camera(1.4, 0.5), light(32).requires_grad_()
        far = torch.full((1, 1, 32, 32), float("inf"))
        said = "gradients of masks are computed through PSFs of at most 257 px, got [67][0-9]{2} px: freeze the masks"
        with pytest.raises(RuntimeError, match=said):
            optics(image, far).sum().backward()
        optics.masks.requires_grad_(False)
        optics(image, far).sum().backward()
        assert torch.isfinite(image.grad).all()
        narrow = ThinLensCamera(50e-3, 50e-3 / 1.4, 0.5, 6e-6, depth_range=(0.46, 0.54))
        for lens, depth in ((narrow, 0.46), (fast_camera(2.8, 2.0).camera, 1.6)):
            learnt = TiDyOptics(PixelwiseMask(1, initial="flat"), lens, sensor=None, color_space="linear")
            learnt(image, torch.full_like(far, depth)).square().mean().backward()
            assert float(learnt.masks.phase.grad.abs().max()) > 0

    @torch.no_grad()
    @pytest.mark.parametrize("f_number", [1.4, 2.8, 4.0])
    def test_feature_a_capture_depends_on_nothing_but_what_its_psfs_reach(self, f_number):
        """Neither on captures before it, nor on pixels farther away than any PSF; it was by up to 0.02."""
        image, near = light(192), torch.full((1, 1, 192, 192), 2.0)
        alone = fast_camera(f_number)(image, near)
        optics = fast_camera(f_number)
        optics(image, torch.linspace(1.6, 9.0, 192).expand(1, 1, 192, 192))
        assert torch.equal(optics(image, near), alone)
        near[..., :8, :8] = 2.4
        reach = 8 + optics.window // 2
        assert reach < 160
        apart = (fast_camera(f_number)(image, near) - alone)[..., reach:, reach:]
        assert float(apart.abs().max()) < 2e-6

    @torch.no_grad()
    def test_feature_bands_are_the_whole(self):
        optics, image, depth = fast_camera(), light(192), stairs(192)
        whole = optics(image, depth)
        optics.memory_budget = 1
        self.assert_close(optics(image, depth), whole, rtol=0, atol=2e-6)

    @torch.no_grad()
    def test_feature_white_behind_something_near_stays_white(self):
        """Geometric discs end, and so does what occlusion sees through them: it was 0.83 at the outline."""
        optics, depth = fast_camera(1.8, compositing="occlusion"), torch.full((1, 1, 128, 128), 2.0)
        depth[..., :64] = 1.55
        white = optics(torch.ones(1, 3, 128, 128), depth)
        assert 0.997 < float(white.min()) <= float(white.max()) < 1 + 1e-5

    def test_exception_of_occlusion_beyond_the_memory(self):
        optics = fast_camera(1.4, 0.5, compositing="occlusion")
        with pytest.raises(ValueError, match=r"needs 181 layers of PSFs 699 px wide, some .* GiB"):
            optics(light(64), stairs(64))

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    @pytest.mark.parametrize("ask", ["__call__", "explain"])
    def test_exception_an_image_smaller_than_the_psfs_that_must_lie_within(self, compositing, ask):
        optics = fast_camera(border="valid", compositing=compositing)
        with pytest.raises(ValueError, match=r"at least .* pixels a side for PSFs of .*, got 12x13"):
            getattr(optics, ask)(torch.ones(1, 3, 12, 13), torch.full((1, 1, 12, 13), 1.6))

    @torch.no_grad()
    @pytest.mark.parametrize("aperture", sorted(APERTURES))
    def test_feature_other_apertures_are_as_exact_as_the_disc(self, aperture):
        """Half way between layers, near focus and far, where rays begin and on grids: rings were off 2.7 times."""
        optics, image = fast_camera(1.8, aperture=APERTURES[aperture]), light(128)
        blur, step = optics.psf_model.wide_blur, float(optics.psf_model.pixel_step)
        nodes = torch.tensor(blur.nodes)
        for radius in (0.15, 0.6, 1.0, 1.1 * blur.ray_radius, 30.0, 53.0):
            psi = -min(radius, 53.0) * math.pi * step / REFERENCE_WAVELENGTH
            after = int(torch.searchsorted(nodes, psi))
            at = torch.full((1, 1, 128, 128), float(nodes[after - 1] + nodes[after]) / 2)
            pieces = pieces_of(optics.psf_model, 1, torch.float32, at)
            seen = sum(render_piece(image, at, piece, Rendering("gather", "circular")) for piece in pieces)
            exact = exact_psf_bank(
                torch.zeros(1, 23, 23), torch.ones(1), optics.pupil, Spectrum.monochrome(), [1.0],
                [float(at[0, 0, 0, 0])], step, blur.window, 1e-2,
            ).psfs  # fmt: skip
            exact = gather(image, at, at[0, 0, 0, :1], exact / exact.sum(), layers="nearest", border="circular")
            assert float((seen - exact).square().mean().sqrt()) < 1.3 * ERROR, radius

    @torch.no_grad()
    def test_smoke_the_plan_names_the_approximations_and_their_error(self):
        optics, depth = fast_camera(1.8), stairs(64)
        plan = optics.plan(depth, light(64), tolerance=1e-2)
        assert plan.predicted_error < 3e-3
        assert "geometric optics" in str(plan)
        assert "layers of wide blur" in optics.explain(light(64), depth).scene
        # Of so small a picture no border continues what windows of 131 pixels reach.
        assert "above the tolerance of 1e-05" in str(optics.plan(depth, light(64), tolerance=1e-5))

    @torch.no_grad()
    @pytest.mark.parametrize(
        ("aperture", "tolerance"),
        [
            ("thin ring", 3e-3),
            *(pytest.param(name, 3e-4, marks=pytest.mark.takes_seconds) for name in sorted(APERTURES)),
        ],
    )
    def test_feature_plans_keep_their_tolerance_whatever_the_aperture(self, aperture, tolerance):
        """By rays where they are exact enough, else by waves: rings were off 4.9 times."""
        optics, image, depth = fast_camera(2.8, aperture=APERTURES[aperture]), light(64), stairs(64)
        plan = optics.plan(depth, image, tolerance)
        assert plan.predicted_error <= tolerance
        exact = optics.with_fidelity(plan.reference)(image, depth)
        error = float((optics.with_fidelity(plan.fidelity)(image, depth) - exact).square().mean().sqrt())
        assert error <= plan.predicted_error
        assert tolerance < 1e-3 or plan.fidelity == optics.fidelity

    def test_smoke_states_of_wide_lenses_load(self):
        optics, other = fast_camera(), fast_camera()
        other.load_state_dict(optics.state_dict())
        assert other.psf_model.wide_blur == optics.psf_model.wide_blur is not None
