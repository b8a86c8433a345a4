from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, SpatialLightModulator, Switching, TiDyOptics
from kornia_tidy.augmentation import RandomTiDyOptics
from kornia_tidy.optics import DefocusRange, ThinLensCamera
from tests.base import BaseTester
from tests.camera.pipeline_samples import FAST, camera, scene

ALL = {
    "exposure": (0.5, 1.5),
    "focus_distance": (0.5, 0.8),
    "aperture_diameter": (2e-3, 3e-3),
    "mask_jitter": (0.1, 0.3),
    "noise_level": (0.01, 0.02),
    "switching_time": (1e-3, 4e-3),
}


class Plain(torch.nn.Module):
    """A sensor that records light as it is."""

    def forward(self, irradiance, params=None, generator=None, origin=(0, 0)):
        return irradiance


class TestRandomTiDyOptics(BaseTester):
    @pytest.mark.parametrize("keepdim", [True, False])
    @pytest.mark.parametrize("shape", [(2, 3), (3,), (1, 1), (0, 3)])
    def test_cardinality(self, shape, keepdim):
        image, depth = torch.rand(*shape, 40, 48), torch.ones(*shape[:-1], 1, 40, 48)
        coded = RandomTiDyOptics(camera(), p=1.0, keepdim=keepdim)(image, depth)
        assert coded.shape == (image.shape if keepdim or image.ndim == 4 else (1, *image.shape))

    def test_feature_one_depth_for_all_images(self):
        optics, (image, depth) = RandomTiDyOptics(camera(sensor=None), p=1.0), scene(3)
        self.assert_close(optics(image, depth[:1]), optics.optics(image, depth[:1].expand(3, -1, -1, -1)))

    def test_feature_without_ranges_it_is_the_camera(self):
        optics, (image, depth) = RandomTiDyOptics(camera(sensor=None), p=1.0), scene(2)
        self.assert_close(optics(image, depth), optics.optics(image, depth))

    def test_feature_draws_lie_in_their_ranges_and_differ_between_images(self):
        params = RandomTiDyOptics(camera(), **ALL).forward_parameters((64, 3, 8, 8))
        for name, (low, high) in ALL.items():
            assert ((low <= params[name]) & (params[name] <= high)).all()
            assert params[name].unique().numel() > 32

    def test_feature_each_image_is_taken_with_its_own_lens(self):
        """Against cameras made by hand for each image."""
        image, depth = scene(3)
        masks = PixelwiseMask(2)
        optics = RandomTiDyOptics(
            TiDyOptics(masks, fidelity=FAST, sensor=None),
            focus_distance=(0.5, 0.8),
            aperture_diameter=(2e-3, 3e-3),
            p=1,
        )
        coded = optics(image, depth)
        for row in range(3):
            lens = ThinLensCamera(
                aperture_diameter=float(optics._params["aperture_diameter"][row]),
                focus_distance=float(optics._params["focus_distance"][row]),
                depth_range=optics.optics.camera.depth_range,
            )
            alone = TiDyOptics(masks, lens, fidelity=FAST, sensor=None)(image[row : row + 1], depth[row : row + 1])
            self.assert_close(coded[row : row + 1], alone)

    def test_feature_switching_is_that_of_the_modulator(self):
        image, depth = scene(1)
        masks = PixelwiseMask(3)
        optics = RandomTiDyOptics(TiDyOptics(masks, fidelity=FAST, sensor=None), switching_time=(4e-3, 4e-3), p=1.0)
        coded = optics(image, depth)
        seed = int(optics._params["seed"])
        by_hand = TiDyOptics(masks, modulator=Switching(4e-3, seed=seed), fidelity=FAST, sensor=None)
        self.assert_close(coded, by_hand(image, depth))

    def test_feature_exposure_is_a_factor_of_linear_light(self):
        image, depth = scene(2)
        optics = RandomTiDyOptics(camera(sensor=None, color_space="linear"), exposure=(0.3, 2.0), p=1.0)
        factor = optics(image, depth) / optics.optics(image, depth)
        self.assert_close(factor, optics._params["exposure"].view(-1, 1, 1, 1).expand_as(factor))

    def test_feature_noise_has_the_drawn_level(self):
        image, depth = torch.full((2, 3, 60, 60), 0.5), torch.full((2, 1, 60, 60), 0.6)
        linear = camera(color_space="linear", sensor=SensorNoise(0.5, clip=False))
        optics = RandomTiDyOptics(linear, noise_level=(0.01, 0.05), p=1.0)
        noise = optics(image, depth) - 0.5
        ratio = noise.flatten(1).std(1) / optics._params["noise_level"]
        # The standard deviation of n normal numbers has a relative error of 1 / sqrt(2 n): six of them.
        assert (ratio - 1).abs().max() < 6 / math.sqrt(2 * noise[0].numel())

    def test_feature_a_blurred_mask_error_changes_the_image_and_zero_does_not(self):
        image, depth = scene(1)
        plain, none, some = (
            RandomTiDyOptics(camera(masks=PixelwiseMask(1, initial="flat"), sensor=None), mask_jitter=x, p=1.0)(
                image, depth
            )
            for x in (None, (0.0, 0.0), (1.0, 1.0))
        )
        assert torch.equal(plain, none)
        assert (plain - some).abs().max() > 1e-2

    def test_feature_the_same_params_give_the_same_bits_and_other_rows_change_nothing(self):
        optics, (image, depth) = RandomTiDyOptics(camera(), **ALL, p=0.5), scene(4)
        coded, params = optics(image, depth), optics._params
        assert torch.equal(optics(image, depth, params=params), coded)
        some = {
            name: value[1:3] if len(value) == 4 and name != "forward_input_shape" else value
            for name, value in params.items()
        }
        part = optics(image[1:3], depth[1:3], params=some)
        self.assert_close(part, coded[1:3], rtol=0, atol=1e-6)

    def test_feature_rows_that_are_left_out_are_not_computed_and_keep_their_bits(self):
        optics, (image, depth) = RandomTiDyOptics(camera(), p=0.5), scene(4)
        seen = []
        optics.optics.register_forward_pre_hook(lambda _, args: seen.append(len(args[0])))
        params = {**optics.forward_parameters(image.shape), "batch_prob": torch.tensor([1.0, 0.0, 0.0, 1.0])}
        depth[1:3] = torch.nan  # would be refused
        coded = optics(image, depth, params=params)
        assert torch.equal(coded[1:3], image[1:3])
        assert not torch.equal(coded[0], image[0])
        assert torch.equal(RandomTiDyOptics(camera(), p=0.0)(image, depth), image)

    def test_feature_depth_is_read_in_float32_whatever_the_image_is(self):
        """Between 0.595 m and 0.6 m bfloat16 knows four depths: a wide aperture tells them apart."""
        image, depth = scene(1)
        depth = 0.595 + 5e-3 * torch.rand_like(depth)
        wide = ThinLensCamera(aperture_diameter=30e-3, depth_range=(0.59, 0.605))
        optics = RandomTiDyOptics(camera(camera=wide, sensor=None), p=1.0)
        half = optics(image.bfloat16(), depth)
        self.assert_close(half, optics.optics(image.bfloat16().float(), depth).bfloat16(), rtol=0, atol=2**-8)
        assert (optics.optics(image, depth) - optics.optics(image, depth.bfloat16().float())).abs().max() > 2**-6

    def test_feature_gradients_reach_the_masks_through_all_draws(self):
        optics, (image, depth) = RandomTiDyOptics(camera(), **ALL, p=1.0), scene(2)
        optics(image, depth).square().mean().backward()
        gradient = optics.optics.masks.phase.grad
        assert gradient.isfinite().all()
        assert (gradient.abs().amax((1, 2)) > 0).all()

    def test_feature_the_draws_hold_no_depth(self):
        optics, (image, depth) = RandomTiDyOptics(camera(), **ALL), scene(2)
        optics(image, depth)
        assert set(optics._params) == {*ALL, "seed", "batch_prob", "forward_input_shape"}
        assert all(value.numel() <= 4 for value in optics._params.values())

    def test_exception_ranges(self):
        with pytest.raises(ValueError, match=r"exposure must be a range \(low, high\) with 0 < low <= high"):
            RandomTiDyOptics(camera(), exposure=(1.0, 0.5))
        with pytest.raises(TypeError, match="noise_level must be a range"):
            RandomTiDyOptics(camera(), noise_level=0.1)
        with pytest.raises(ValueError, match="focus_distance must be beyond the focal length"):
            RandomTiDyOptics(camera(), focus_distance=(0.01, 1.0))
        with pytest.raises(ValueError, match="transitions of 40 ms must fit into the exposure"):
            RandomTiDyOptics(camera(), switching_time=(0.0, 0.04))

    def test_exception_parts_that_a_range_needs(self):
        with pytest.raises(TypeError, match="need a ThinLensCamera, whose depth is in metres"):
            RandomTiDyOptics(camera(camera=DefocusRange()), focus_distance=(0.5, 1.0))
        with pytest.raises(TypeError, match="noise_level needs a SensorNoise"):
            RandomTiDyOptics(camera(sensor=Plain()), noise_level=(0.0, 0.1))
        with pytest.raises(TypeError, match="switching_time needs a modulator of DwellTimes or Switching"):
            RandomTiDyOptics(camera(modulator=SpatialLightModulator()), switching_time=(0.0, 1e-3))
        with pytest.raises(TypeError, match="optics must be a camera"):
            RandomTiDyOptics(torch.nn.Identity())
        with pytest.raises(ValueError, match="border 'valid' gives smaller images"):
            RandomTiDyOptics(camera(border="valid"))

    def test_exception_samples_and_missing_depth(self):
        optics, (image, depth) = RandomTiDyOptics(camera()), scene(1)
        with pytest.raises(TypeError, match="OpticsPipeline takes tuples and mappings"):
            optics({"image": image, "depth": depth})
        with pytest.raises(ValueError, match="RandomTiDyOptics got no depth"):
            optics(image)
        with pytest.raises(ValueError, match=r"depth must have shape \(B, 1, H, W\)"):
            optics(image, depth[0])

    @pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
    def test_dynamo(self):
        optics, (image, depth) = RandomTiDyOptics(camera(), **ALL, p=0.5), scene(2)
        params = optics.forward_parameters(image.shape)
        compiled = torch.compile(optics, backend="eager")
        self.assert_close(compiled(image, depth, params=params), optics(image, depth, params=params))


class TestBehindALens(BaseTester):
    def augmentation(self, **options) -> RandomTiDyOptics:
        masks = PixelwiseMask(1, generator=torch.Generator().manual_seed(3))
        fast = Fidelity(window=9, layer_spacing=20.0, field_tolerance=0.3)
        optics = TiDyOptics(masks, lens="single-50mm", fidelity=fast, sensor=None, **options)
        return RandomTiDyOptics(optics, p=1.0)

    @torch.no_grad()
    def test_feature_places_are_drawn_over_the_field_and_repeated(self):
        augmentation, (image, depth) = self.augmentation(), scene(3)
        torch.manual_seed(2)
        coded = augmentation(image, depth)
        places = augmentation._params["field_center"]
        reach = augmentation.optics.lens.field / 8e-6
        corners = places.norm(dim=1) + math.hypot(*image.shape[-2:]) / 2
        assert places.shape == (3, 2)
        assert bool((corners <= reach).all())
        assert len({tuple(place) for place in places.tolist()}) == 3
        expected = augmentation.optics(image, depth, field_center=places)
        assert torch.equal(coded, expected)
        assert torch.equal(augmentation(image, depth, params=augmentation._params), coded)
        assert not torch.equal(augmentation(image, depth), coded)

    def test_feature_a_place_that_the_camera_says_stays(self):
        augmentation, (image, depth) = self.augmentation(field_center=(300.0, 0.0)), scene(2)
        coded = augmentation(image, depth)
        assert "field_center" not in augmentation._params
        assert torch.equal(coded, augmentation.optics(image, depth))

    @torch.no_grad()
    def test_feature_one_place_for_the_batch(self):
        augmentation = RandomTiDyOptics(self.augmentation().optics, p=1.0, same_on_batch=True)
        drawn = augmentation.forward_parameters((3, 3, 40, 40))["field_center"]
        assert torch.equal(drawn, drawn[:1].expand(3, 2))

    def test_feature_the_default_camera_takes_a_lens(self):
        augmentation = RandomTiDyOptics(lens="double-gauss-50mm")
        assert augmentation.optics.lens.name == "double-gauss-50mm"
        assert augmentation.optics.camera.focal_length == augmentation.optics.lens.focal_length
        with pytest.raises(ValueError, match="optics has its own lens: give lens to TiDyOptics"):
            RandomTiDyOptics(TiDyOptics(), lens="double-gauss-50mm")
