"""A scene that moves under changing masks: at rest it is the ordinary capture, and light adds state by state."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import map_coordinates

from kornia_tidy import DwellTimes, Fidelity, LearnableDwellTimes, PixelwiseMask, SensorNoise, Switching, TiDyOptics
from kornia_tidy.camera.motion import moving_capture, scenes_by_flow, scenes_by_homography
from kornia_tidy.masks import metres_to_radians
from kornia_tidy.modulator import GreyLevels, SpatialLightModulator
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=10.0, stray_light="discard")


def camera(masks=3, modulator=None, sensor=None, **options) -> TiDyOptics:
    options = {"fidelity": SMALL, "color_space": "linear", **options}
    return TiDyOptics(PixelwiseMask(masks), modulator=modulator, sensor=sensor, **options)


def scene(dtype=torch.float64, batch=2, channels=3):
    return torch.rand(batch, channels, 26, 22, dtype=dtype), 0.3 + torch.rand(batch, 1, 26, 22, dtype=dtype)


def at_rest(optics, image, depth):
    states = len(optics.state_weights(torch.float64))
    return image[:, None].repeat(1, states, 1, 1, 1), depth[:, None].repeat(1, states, 1, 1, 1)


def shifts(pixels, dtype=torch.float64):
    """Homographies that move by so many pixels to the right and down."""
    moves = torch.eye(3, dtype=dtype).repeat(len(pixels), 1, 1)
    moves[:, :2, 2] = torch.tensor(pixels, dtype=dtype)
    return moves


class TestMovingCapture(BaseTester):
    def test_exception(self):
        optics = camera()
        images, depths = at_rest(optics, *scene())
        with pytest.raises(ValueError, match=r"images must have one scene for each of the 3 moments .*, got 2"):
            moving_capture(optics, images[:, :2], depths)
        with pytest.raises(ValueError, match=r"depths must have one scene for each of the 3 moments .*, got 1"):
            moving_capture(optics, images, depths[:, :1])
        with pytest.raises(ValueError, match="one scene for each of the 5 moments of the exposure, got 3"):
            moving_capture(camera(modulator=Switching(4e-3)), images, depths)
        with pytest.raises(ValueError, match=r"depths must have shape \(B, M, 1, H, W\)"):
            moving_capture(optics, images, depths[0])
        with pytest.raises(ValueError, match=r"images must have shape \(B, M, C, H, W\)"):
            moving_capture(optics, images[0, 0], depths[0, 0])
        with pytest.raises(TypeError, match=r"images must be a torch\.Tensor"):
            moving_capture(optics, images.numpy(), depths)
        with pytest.raises(ValueError, match="depth must be positive metres"):
            moving_capture(optics, images, -depths)
        images[1, 2] = math.nan
        with pytest.raises(ValueError, match="image must be finite"):
            moving_capture(optics, images, depths)

    def test_cardinality(self, device, dtype):
        optics = camera().to(device)
        images, depths = (x.to(device, dtype) for x in at_rest(optics, *scene()))
        coded = moving_capture(optics, images, depths.float())
        assert (coded.shape, coded.dtype) == ((2, 3, 26, 22), dtype)
        assert moving_capture(optics, images[0], depths[0].float()).shape == (3, 26, 22)
        assert moving_capture(camera(border="valid"), images, depths.float()).shape == (2, 3, 18, 14)
        assert moving_capture(optics, images[:, :, :1], depths.float()).shape == (2, 1, 26, 22)

    @pytest.mark.parametrize("color_space", ["srgb", "linear"])
    def test_feature_at_rest_in_any_colour_space_with_the_same_noise(self, color_space):
        optics = camera(sensor=SensorNoise(0.02, full_well=500), color_space=color_space)
        image, depth = scene()
        params = optics.draw(image, generator=torch.Generator().manual_seed(3))
        with torch.no_grad():
            moving = moving_capture(optics, *at_rest(optics, image, depth), params=params)
            self.assert_close(moving, optics(image, depth, params=params), rtol=0, atol=1e-10)
            seeded = [torch.Generator().manual_seed(5) for _ in range(2)]
            moving = moving_capture(optics, *at_rest(optics, image, depth), generator=seeded[0])
            self.assert_close(moving, optics(image, depth, generator=seeded[1]), rtol=0, atol=1e-10)

    def test_feature_veil_agrees_at_rest_and_renormalised_states_keep_white_only(self):
        image, depth = scene()
        white = torch.ones_like(image)
        apart = {}
        for kind in ("veil", "renormalize"):
            optics = camera(fidelity=SMALL.replace(stray_light=kind, double=True))
            with torch.no_grad():
                apart[kind] = (
                    (moving_capture(optics, *at_rest(optics, image, depth)) - optics(image, depth)).abs().max()
                )
                self.assert_close(moving_capture(optics, *at_rest(optics, white, depth)), white, rtol=0, atol=1e-9)
        assert float(apart["veil"]) < 1e-12
        assert 1e-5 < float(apart["renormalize"]) < 0.05

    def test_feature_gradients_reach_masks_dwell_times_and_scenes(self):
        optics = camera(3, LearnableDwellTimes((1, 1, 1)))
        images, depths = at_rest(optics, *scene(torch.float32))
        images.requires_grad_()
        moving_capture(optics, images, depths).square().mean().backward()
        assert bool((optics.masks.phase.grad.abs().amax((1, 2)) > 0).all())
        assert float(optics.modulator.logits.grad.abs().max()) > 0
        assert bool((images.grad.abs().amax((0, 2, 3, 4)) > 0).all())

    def test_feature_depths_out_of_range_are_warned_about_once(self):
        optics, (image, depth) = camera(), scene()
        with pytest.warns(UserWarning, match="beyond the camera's range") as caught:
            moving_capture(optics, *at_rest(optics, image, depth * 0.2))
        assert len(caught) == 1
        assert optics.clamped_pixels == len(optics.state_weights(depth.dtype)) * depth.numel()
        moving_capture(optics, *at_rest(optics, image, depth))
        assert optics.clamped_pixels == 0

    def test_feature_psfs_are_computed_once_for_scenes_that_follow(self, monkeypatch):
        optics, (image, depth) = camera(), scene(torch.float32)
        built = []
        build = PSFModel._exact_psfs
        monkeypatch.setattr(PSFModel, "_exact_psfs", lambda self, *a, **k: built.append(1) or build(self, *a, **k))
        with torch.no_grad():
            for _ in range(3):
                moving_capture(optics, *at_rest(optics, image, depth))
        assert len(built) == 3  # one bank a state


class TestThroughState(BaseTester):
    def test_feature_it_is_that_state_alone(self):
        optics = camera(modulator=Switching(8e-3, between="linear", samples=2))
        phases = optics.psf_model.states(torch.float32)[0].detach()
        for state in (0, 2, 3, 6):
            one = optics.through_state(state)
            masks = PixelwiseMask(initial=phases[state, None] / metres_to_radians(optics.masks.material))
            alone = TiDyOptics(masks, optics.camera, fidelity=SMALL)
            self.assert_close(one.psf_bank().psfs, alone.psf_bank().psfs, rtol=1e-4, atol=1e-8)
            self.assert_close(one.through_state(0).psf_bank().psfs, one.psf_bank().psfs)
            assert one.state_weights(torch.float32).tolist() == [1.0]
            assert one.window == optics.window

    def test_feature_remembered_states_follow_the_masks_and_send_gradients_to_their_own(self):
        optics = camera()
        with torch.no_grad():
            first = [optics.through_state(k).psf_bank().psfs for k in range(2)]
            assert torch.equal(optics.through_state(1).psf_bank().psfs, first[1])
            optics.masks.phase[1] += torch.rand(23, 23)
            second = [optics.through_state(k).psf_bank().psfs for k in range(2)]
        assert torch.equal(second[0], first[0])
        assert not torch.allclose(second[1], first[1])
        optics.through_state(1).psf_bank().psfs.square().sum().backward()
        assert [bool(gradient.any()) for gradient in optics.masks.phase.grad] == [False, True, False]

    def test_exception(self):
        for state in (-1, 3):
            with pytest.raises(ValueError, match=f"state must be from 0 to 2, got {state}"):
                camera().through_state(state)


class TestStateTimes(BaseTester):
    def test_feature_dwell_times_follow_one_another(self):
        times = camera(modulator=DwellTimes((1, 2, 1))).timeline(torch.float32).state_times()
        self.assert_close(times, torch.tensor([0.125, 0.5, 0.875]))

    @pytest.mark.parametrize("cyclic", [False, True])
    def test_feature_states_between_masks_stand_between_them(self, cyclic):
        """Masks at the middles of what swaps leave, and between two of them as many in order as there are samples."""
        switching = Switching(10e-3, 0.1, "linear", cyclic=cyclic, samples=2)
        optics = camera(modulator=SpatialLightModulator(GreyLevels(8), switching))
        times, weights = optics.timeline(torch.float32).state_times(), optics.state_weights(torch.float32)
        order = times.argsort()
        names = order.tolist()
        swaps = 3 if cyclic else 2
        assert names[:4] == [0, 3, 3 + swaps, 1]
        assert names[-1] == (5 + swaps if cyclic else 2)
        self.assert_close((times * weights).sum(), torch.tensor(0.5), atol=0.06 if cyclic else 1e-5)
        stand = (1 - 0.1 * swaps) / 3
        self.assert_close(times[:3], torch.tensor([(k + 0.5) * stand + 0.1 * k for k in range(3)]))

    def test_feature_random_states_stand_in_the_middle_of_their_swap(self):
        times = camera(modulator=Switching(10e-3, 0.1)).timeline(torch.float32).state_times()
        self.assert_close(times, torch.tensor([2 / 15, 0.5, 13 / 15, 0.8 / 3 + 0.05, 1.6 / 3 + 0.15]))
        assert camera(modulator=Switching(0.0)).timeline(torch.float32).state_times().shape == (3,)


class TestScenes(BaseTester):
    @pytest.mark.parametrize(
        ("make", "motion", "sentence"),
        [
            (scenes_by_homography, torch.eye(3), r"homographies must have shape \(M, 3, 3\) or \(B, M, 3, 3\), got"),
            (scenes_by_flow, torch.zeros(1, 2, 5, 5), r"\(M, 2, 26, 22\) or .* got \(1, 2, 5, 5\)"),
            (scenes_by_homography, torch.eye(3).repeat(3, 1, 1, 1), "motion must be that of 2 images, got 3"),
        ],
    )
    def test_exception(self, make, motion, sentence):
        image, depth = scene()
        with pytest.raises(ValueError, match=sentence):
            make(image, depth, motion)
        with pytest.raises(ValueError, match=r"depth must have shape \(2, 1, 26, 22\) to fit the image"):
            make(image, depth.mT, motion)
        with pytest.raises(ValueError, match=r"image must have shape \(B, C, H, W\)"):
            make(image[0], depth, motion)

    def test_cardinality(self, dtype):
        image, depth = (x.to(dtype) for x in scene())
        moves = shifts([(0, 0), (1, 2), (3, 4)], torch.float32)
        flows = torch.zeros(3, 2, 26, 22)
        for images, depths in (scenes_by_homography(image, depth, moves), scenes_by_flow(image, depth, flows)):
            assert (images.shape, depths.shape) == ((2, 3, 3, 26, 22), (2, 3, 1, 26, 22))
            assert images.dtype == depths.dtype == dtype
        assert scenes_by_homography(image, depth, moves.repeat(2, 1, 1, 1))[0].shape == (2, 3, 3, 26, 22)

    def test_feature_one_depth_is_that_of_all_images(self):
        image, depth = scene()
        shift, repeated = shifts([(1, 2)]), depth[:1].expand(2, -1, -1, -1)
        found, expected = scenes_by_homography(image, depth[:1], shift), scenes_by_homography(image, repeated, shift)
        for one, each in zip(found, expected, strict=True):
            assert torch.equal(one, each)

    def test_feature_a_homography_against_scipy(self):
        image, depth = scene(batch=1, channels=1)
        turn = torch.tensor([[0.98, -0.05, 1.5], [0.04, 1.03, -0.7], [1e-4, -2e-4, 1.0]], dtype=torch.float64)
        images, depths = scenes_by_homography(image, depth, turn[None])
        back = torch.linalg.inv(turn).numpy()
        y, x = (
            axis.numpy().astype(float) for axis in torch.meshgrid(torch.arange(26), torch.arange(22), indexing="ij")
        )
        w = back[2, 0] * x + back[2, 1] * y + back[2, 2]
        came = [(back[i, 0] * x + back[i, 1] * y + back[i, 2]) / w for i in (1, 0)]
        expected = map_coordinates(image[0, 0].numpy(), came, order=1, mode="nearest")
        self.assert_close(images[0, 0, 0], torch.from_numpy(expected), rtol=0, atol=1e-12)
        expected = map_coordinates(depth[0, 0].numpy(), came, order=0, mode="nearest")
        self.assert_close(depths[0, 0, 0], torch.from_numpy(expected), rtol=0, atol=0)

    def test_feature_flow_and_homography_of_one_translation_agree(self):
        image, depth = scene()
        flows = torch.tensor([(2.0, -1.0), (0.5, 0.25)], dtype=torch.float64)[..., None, None].expand(2, 2, 26, 22)
        for a, b in zip(
            scenes_by_flow(image, depth, flows),
            scenes_by_homography(image, depth, shifts([(2.0, -1.0), (0.5, 0.25)])),
            strict=True,
        ):
            self.assert_close(a, b, rtol=0, atol=1e-12)

    def test_feature_no_depth_appears_that_is_not_in_the_scene_and_infinity_stays(self):
        image, depth = scene()
        depth[..., :11] = math.inf
        depths = scenes_by_homography(image, depth, shifts([(0.4, 0.3), (-1.6, 0.5)]))[1]
        assert set(depths.unique().tolist()) <= set(depth.unique().tolist())
        assert not bool(depths.isnan().any())
        assert bool(depths.isinf().any())

    def test_gradcheck(self):
        image, depth = torch.rand(1, 1, 5, 6, dtype=torch.float64), torch.ones(1, 1, 5, 6, dtype=torch.float64)
        moves = shifts([(0.3, 0.4)]).requires_grad_()
        self.gradcheck(lambda i, m: scenes_by_homography(i, depth, m)[0], (image.requires_grad_(), moves))
