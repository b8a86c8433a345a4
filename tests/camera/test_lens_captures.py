"""Captures through a real lens: each pixel sees the PSF of its place, against PSFs computed for single pixels."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from torch.nn.functional import pad

from kornia_tidy import Fidelity, NoMask, PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.camera import burst, camera_of_state, moving_capture
from kornia_tidy.optics import Lens, Spectrum
from kornia_tidy.render import render
from kornia_tidy.render.borders import BORDERS
from tests.base import BaseTester, shared

CORNER = (507.0, 593.0)  # px from the axis, of a picture of 1282x1110 px
SETTINGS = Fidelity(window=17, layer_spacing=10.0, field_tolerance=1e-2, occlusion_states="mean")


def camera(compositing: str = "gather", border: str = "reflect", center=CORNER, **parts) -> TiDyOptics:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(3))
    parts = {"fidelity": SETTINGS, "lens": "single-50mm", "spectrum": Spectrum.monochrome(), **parts}
    settings = {"sensor": None, "color_space": "linear", "compositing": compositing, "border": border}
    return TiDyOptics(masks, field_center=center, **settings, **parts)


def off_stop(mask_shift: float) -> dict:
    """The parts of a camera with its masks off the stop."""
    lens = Lens.named("single-50mm", 17.6, 0.595).with_masks_off_stop(mask_shift)
    return {"lens": lens, "camera": lens.camera(8e-6)}


def scene(height: int = 72, width: int = 100, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Noise of light, and steps of depth from near to far."""
    generator = torch.Generator().manual_seed(seed)
    steps = torch.rand(1, 1, height // 12 + 1, width // 12 + 1, generator=generator)
    inverse = 0.2 + 3 * steps.repeat_interleave(12, 2).repeat_interleave(12, 3)[..., :height, :width]
    return torch.rand(1, 1, height, width, generator=generator), 1 / inverse


def place(optics: TiDyOptics, image: torch.Tensor, pixel: tuple[int, int]) -> tuple[float, float]:
    """Where a pixel lies, from the axis."""
    return tuple(
        c + p - (side - 1) / 2 for c, p, side in zip(optics.field_center, pixel, image.shape[-2:], strict=True)
    )


PIXELS = [(0, 0), (35, 50), (63, 64), (71, 99), (20, 81)]


class TestLensCaptures(BaseTester):
    def test_feature_gradients_of_torch_func_are_those_of_autograd(self):
        """Of a picture of a size that no capture had before, whose nodes are found within the transform."""
        optics, (image, depth) = camera(), scene(41, 43)
        phases = {"masks.phase": optics.masks.get_parameter("phase")}

        def light(phases):
            return torch.func.functional_call(optics, phases, (image, depth)).square().mean()

        found = torch.func.grad(light)({name: phase.detach() for name, phase in phases.items()})["masks.phase"]
        self.assert_close(
            found,
            torch.autograd.grad(light(phases), phases["masks.phase"])[0],
            rtol=0,
            atol=1e-3 * float(found.abs().max()),
        )

    @pytest.mark.parametrize(
        ("compositing", "border", "mask_shift"),
        [*(("gather", border, 0.0) for border in BORDERS), ("occlusion", "zero", 0.0), ("gather", "zero", 22.0)],
    )
    @torch.no_grad()
    def test_feature_a_pixel_sees_through_the_psf_of_its_place(self, compositing, border, mask_shift):
        """The whole picture is rendered through one pixel's PSFs, which must give that pixel."""
        optics, (image, depth) = camera(compositing, border, **off_stop(mask_shift)), scene()
        seen, margin = optics(image, depth), 8 if border == "valid" else 0
        lost = []
        for pixel in PIXELS:
            sides = zip(pixel, image.shape[-2:], strict=True)
            y, x = (min(max(p, margin), side - 1 - margin) for p, side in sides)
            bank = optics.psf_bank(field=[place(optics, image, (y, x))])
            axis, light = PSFBank(bank.psfs[0], bank.defocus, bank.energy[0]), bank.light[0, :, :].mean(0)
            options = {"compositing": compositing, "border": border}
            own = render(image, optics.camera.defocus(depth), axis, **options)[0, :, y - margin, x - margin]
            own = own * light if compositing == "occlusion" else own  # whose PSFs are normalised
            lost.append((own - seen[0, :, y - margin, x - margin]).abs().max())
        assert float(torch.stack(lost).max()) < 1e-3  # of full scale

    @torch.no_grad()
    def test_feature_light_scatters_by_the_psf_of_where_it_comes_from(self):
        optics, (image, depth) = camera("scatter", "zero"), scene()
        for y, x in PIXELS:
            points = torch.zeros_like(image)
            points[..., y, x] = 1
            seen = pad(optics(points, depth), (8,) * 4)[..., y : y + 17, x : x + 17]
            psfs = optics.psf_bank(field=[place(optics, image, (y, x))]).psfs[0]
            nodes, psi = torch.tensor(optics.defocus_nodes), optics.camera.defocus(depth)[0, 0, y, x]
            below = int((nodes <= psi).sum().clamp(1, len(nodes) - 1)) - 1
            share = (psi - nodes[below]) / (nodes[below + 1] - nodes[below])
            psf = torch.lerp(psfs[below], psfs[below + 1], share)
            rows, columns = (
                slice(max(0, 8 - p), min(17, side - p + 8)) for p, side in zip((y, x), (72, 100), strict=True)
            )
            assert float((seen[0] - psf)[:, rows, columns].norm() / psf.norm()) < 0.02

    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @torch.no_grad()
    def test_feature_the_capture_of_an_independent_program(self, compositing):
        """The corner of a single element's picture, where the PSFs of the axis are wrong by 3.5e-2 of full scale."""
        known = np.load(shared("lenses/capture_single_f17.6.npz"))
        lens = Lens.named("single-50mm", 17.6, 0.595, wavelengths=(530e-9,))
        phase = torch.from_numpy(known["mask"])[None]
        optics = TiDyOptics(
            PixelwiseMask(1, initial=phase * 530e-9 / math.pi),
            lens.camera(8e-6),
            sensor=None,
            lens=lens,
            color_space="linear",
            compositing=compositing,
            border="zero",
            spectrum=Spectrum.monochrome(),
            field_center=CORNER,
            fidelity=Fidelity(window=65, stray_light="discard", layer_spacing=1.0, field_tolerance=1e-3),
        )
        light = torch.from_numpy(known["light"])[None, None]
        psi = torch.from_numpy(known["psi"])[torch.from_numpy(known["label"]).long()][None, None]
        depth = 1 / (1 / optics.camera.focus_distance + psi * 530e-9 / (math.pi * optics.camera.aperture_radius**2))
        white = optics.psf_bank(defocus=[0.0], field=[CORNER]).light[0, 0, 0]
        wrong = (optics(light, depth.float())[0, 0] / white - torch.from_numpy(known[compositing])).abs()
        assert float(wrong.max()) < 1e-3

    @pytest.mark.parametrize(
        ("compositing", "stray_light"), [("gather", "renormalize"), ("occlusion", "renormalize"), ("gather", "veil")]
    )
    @torch.no_grad()
    def test_feature_white_stays_white_times_relative_illumination(self, compositing, stray_light):
        optics, (image, depth) = camera(compositing, fidelity=SETTINGS.replace(stray_light=stray_light)), scene()
        seen = optics(torch.ones_like(image), depth.clamp(0.5, 0.5) if stray_light == "veil" else depth)
        for y, x in PIXELS:
            light = optics.psf_bank(field=[place(optics, image, (y, x))]).light[0].mean(0)
            assert 0.9 < float(light.min()) < 0.99  # this far off the axis
            self.assert_close(seen[0, :, y, x], light, rtol=0, atol=1e-4)

    @pytest.mark.parametrize(
        ("compositing", "border"),
        [("gather", "reflect"), ("gather", "valid"), ("scatter", "reflect"), ("occlusion", "reflect")],
    )
    @torch.no_grad()
    def test_feature_strips_batches_copies_and_captures_before(self, compositing, border):
        optics, (image, depth) = camera(compositing, border, center=(450.0, 520.0)), scene(133, 60)
        whole = optics(image, depth)
        optics(*scene(40, 40, seed=1))
        assert torch.equal(optics(image, depth), whole)
        assert torch.equal(copy.deepcopy(optics)(image, depth), whole)
        other = scene(133, 60, seed=2)
        both = optics(*(torch.cat(pair) for pair in zip((image, depth), other, strict=True)))
        self.assert_close(both[:1], whole, rtol=0, atol=2e-6)  # layers that only the other holds round otherwise
        optics.memory_budget = 1
        self.assert_close(optics(image, depth), whole, rtol=0, atol=1e-5)

    @torch.no_grad()
    def test_feature_a_crop_knows_where_it_lies(self):
        optics, (image, depth) = camera(border="valid", center=(450.0, 520.0)), scene(120, 140)
        whole = optics(image, depth)
        optics.field_center = (450.0 + 20, 520.0 + 30)
        part = optics(image[..., 40:, 60:], depth[..., 40:, 60:])
        self.assert_close(part, whole[..., 40:, 60:], rtol=0, atol=1e-3)

    @torch.no_grad()
    def test_feature_each_image_of_a_batch_has_its_place(self):
        """As an argument, in a mapping, in strips and in a data set."""
        scenes, places = [scene(136, 40, seed) for seed in range(3)], [(450.0, 520.0), (0.0, -20.0), (450.0, 520.0)]
        alone = [camera(center=center)(*one) for one, center in zip(scenes, places, strict=True)]
        optics, centers = camera(center=(0.0, 0.0)), torch.tensor(places)
        image, depth = (torch.cat(parts) for parts in zip(*scenes, strict=True))
        assert float((alone[0] - optics(*scenes[0])).abs().max()) > 0.02
        seen = [optics(image, depth, field_center=centers)]
        seen.append(optics({"image": image, "depth": depth, "field_center": centers})["image"])
        given = zip(image, depth, centers, strict=True)
        samples = [{"image": x, "depth": d[0].numpy(), "field_center": c} for x, d, c in given]
        seen.append(torch.stack([optics.as_transform()(sample)["image"] for sample in samples]))
        optics.memory_budget = 1
        seen.append(optics(image, depth, field_center=centers))
        for captures in seen:
            self.assert_close(captures, torch.cat(alone), rtol=0, atol=1e-5)

    @torch.no_grad()
    def test_feature_each_item_of_a_burst_and_of_a_moving_scene_has_its_place(self):
        settings = SETTINGS.replace(stray_light="discard")
        optics, places = camera(center=(0.0, 0.0), fidelity=settings), [(450.0, 520.0), (0.0, -20.0)]
        image, depth = (torch.cat([part, part]) for part in scene(24, 30))
        expected = optics(image, depth, field_center=places)
        assert float((expected[0] - expected[1]).abs().max()) > 0.02
        self.assert_close(burst(optics, image, depth, field_center=places).sum(1), expected, rtol=0, atol=1e-5)
        moments = [part[:, None].repeat(1, 2, 1, 1, 1) for part in (image, depth)]
        self.assert_close(moving_capture(optics, *moments, field_center=places), expected, rtol=0, atol=1e-5)
        for take, given in ((burst, (image, depth)), (moving_capture, moments)):
            with pytest.raises(ValueError, match="one place, or one for each of 2 images, got 3"):
                take(optics, *given, field_center=[(0.0, 0.0)] * 3)

    def test_gradcheck_of_places(self):
        optics = camera(fidelity=SETTINGS.replace(double=True))
        image, depth = (torch.cat([part, part]).double() for part in scene(9, 9))
        self.gradcheck(lambda x: optics(x, depth, field_center=[(400.0, 500.0), (0.0, 0.0)]), (image,))

    def test_exception_a_veil_behind_what_hides(self):
        optics, (image, depth) = camera("occlusion", fidelity=SETTINGS.replace(stray_light="veil")), scene(24, 24)
        with pytest.raises(ValueError, match="stray_light 'veil' cannot be spread behind things that hide"):
            optics(image, depth)

    @torch.no_grad()
    def test_feature_a_lens_that_does_not_matter_has_one_node(self):
        optics = camera(center=(0.0, 0.0))
        field = optics.psf_model.field_of((16, 16), (0.0, 0.0))
        assert field.nodes == (1, 1)
        image, depth = scene(24, 24)
        axis = optics.psf_bank(field=[(0.0, 0.0)])
        same = render(image, optics.camera.defocus(depth), PSFBank(axis.psfs[0], axis.defocus, axis.energy[0]))
        self.assert_close(optics(image, depth), same, rtol=0, atol=1e-3)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    @torch.no_grad()
    def test_feature_plans_choose_the_places_and_keep_the_tolerance(self, compositing):
        optics, (image, depth) = camera(compositing, center=(450.0, 520.0)), scene(48, 56)
        reference = optics.with_fidelity(
            SETTINGS.replace(field_tolerance=1e-3, layer_spacing=1.0, occlusion_states="each")
        )
        exact, before = reference(image, depth), (99, 99)
        for tolerance in (3e-2, 3e-4):
            plan = optics.plan(depth, image, tolerance=tolerance)
            planned = plan.fidelity.replace(window=17, stray_light="renormalize")  # windows are compared elsewhere
            seen = optics.with_fidelity(planned)(image, depth)
            assert float((seen - exact).square().mean().sqrt()) <= tolerance
            assert plan.predicted_error <= tolerance
            assert plan.fidelity.field_tolerance < before[0]
            before = (plan.fidelity.field_tolerance,)
        assert plan.field != (1, 1)
        assert "places over the picture" in str(plan)

    @torch.no_grad()
    def test_feature_a_plan_is_predicted_to_keep_the_tolerance(self):
        assert camera().plan(scene(24, 24)[1], tolerance=1e-3).predicted_error <= 1e-3

    @torch.no_grad()
    def test_feature_pictures_of_other_sizes_are_remembered_and_do_not_travel(self):
        optics = camera(center=(450.0, 520.0))
        sizes = [(24, 24), (24, 30), (30, 24), (24, 24)]
        captures = [optics(*scene(*size)) for size in sizes]
        assert torch.equal(captures[0], captures[-1])
        assert len(pickle.dumps(optics)) < len(pickle.dumps(camera())) + 20_000

    @pytest.mark.parametrize("mask_shift", [0.0, -22.0])
    @torch.no_grad()
    def test_feature_states_restore_captures_to_the_last_bit(self, mask_shift):
        optics, (image, depth) = camera(**off_stop(mask_shift)), scene(24, 24)
        other = camera(**off_stop(0.0))
        other.masks.phase.data.zero_()
        other.load_state_dict(optics.state_dict())
        assert torch.equal(other(image, depth), optics(image, depth))
        made = camera_of_state(optics.state_dict())
        made.sensor, made.field_center = None, optics.field_center
        assert torch.equal(made(image, depth), optics(image, depth))

    @pytest.mark.parametrize("double", [False, True])
    @torch.no_grad()
    def test_feature_a_psf_does_not_depend_on_those_computed_with_it(self, double):
        model = camera(fidelity=SETTINGS.replace(double=double)).psf_model
        together = model.psf_bank(defocus=[-19.0, -3.0, 2.0, 20.0], field=[(0.0, 0.0), CORNER])
        alone = model.psf_bank(defocus=[2.0], field=[CORNER])
        assert torch.equal(alone.psfs[0, 0], together.psfs[1, 2])

    @pytest.mark.parametrize("name", ["single-50mm", "triplet-50mm"])
    @torch.no_grad()
    def test_smoke_names_fit_the_default_camera(self, name):
        """Without a warning, though a lens's lengths differ a little from the camera's."""
        image, depth = scene(24, 24)
        assert TiDyOptics(NoMask(23), lens=name, fidelity=SETTINGS)(image, depth).shape == image.shape

    @torch.no_grad()
    def test_feature_a_plan_tells_of_a_lens_that_is_left_out(self):
        """The curved field of a thin element is within a tenth that of the single element, traced."""
        optics = TiDyOptics(NoMask(23), fidelity=SETTINGS)
        near, far = (optics.plan(torch.full((1, *size), 0.6), tolerance=1e-2) for size in ((64, 64), (1110, 1282)))
        assert near.left_out == ""
        told = float(far.left_out.split("focuses ")[1].split(" rad")[0])
        lens = Lens.named("single-50mm", optics.camera.f_number, optics.camera.focus_distance)
        defocus = lens.sample(torch.tensor([0.0, lens.field]), torch.zeros(1), 530e-9).wavefront[:, 0, 2]
        assert abs(told / (2 * math.sqrt(3) * float(defocus[0] - defocus[1])) - 1) < 0.1
        assert "leaves out: a real lens (lens=): in the corner, 6.8 mm from the axis" in str(far)

    def test_exception_more_places_than_there_are_warn(self):
        model = camera(fidelity=SETTINGS.replace(field_tolerance=1e-7)).psf_model
        with pytest.warns(UserWarning, match=r"vary so much over 1110x1282 px that 13 places along a side leave a rel"):
            assert max(model.field_of((1110, 1282)).nodes) == 13

    @pytest.mark.parametrize(
        ("center", "error", "message"),
        [
            (5.0, TypeError, "field_center must be two numbers, y and x in sensor pixels, got the number 5.0"),
            ((1, 2, 3), TypeError, "field_center must be two numbers, .* got a tuple"),
            (torch.zeros(4, 2), TypeError, "field_center must be two numbers"),
            ((0.0, math.nan), ValueError, "field_center must be finite, got"),
        ],
    )
    def test_exception_centers(self, center, error, message):
        with pytest.raises(error, match=message):
            camera(center=center)
        optics, (image, depth) = camera(), scene(24, 24)
        optics.field_center = center
        with pytest.raises(error, match=message):
            optics(image, depth)

    @pytest.mark.parametrize(
        ("center", "error", "message"),
        [
            ([(0.0, 0.0)] * 3, ValueError, "field_center must be one place, or one for each of 2 images, got 3"),
            ([(0.0, 0.0), (math.inf, 0.0)], ValueError, "field_center must be finite, got"),
            ([(0.0, 0.0), (1.0,)], TypeError, "field_center must be two numbers, y and x in sensor pixels, got a list"),
            ([], TypeError, "field_center must be two numbers"),
            ("corner", TypeError, "field_center must be two numbers, .* got 'corner'"),
        ],
    )
    def test_exception_places_of_a_batch(self, center, error, message):
        image, depth = (torch.cat([part, part]) for part in scene(24, 24))
        with pytest.raises(error, match=message):
            camera()(image, depth, field_center=[list(c) for c in center] if isinstance(center, list) else center)

    def test_exception_compiling(self):
        optics, (image, depth) = camera(), scene(24, 24)
        with pytest.raises(Exception, match="a camera behind a real lens cannot be compiled or exported"):
            torch.compile(optics, backend="eager", fullgraph=True)(image, depth)
