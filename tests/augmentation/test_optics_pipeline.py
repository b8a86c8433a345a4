from __future__ import annotations

from typing import NamedTuple

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.augmentation import OpticsPipeline, RandomTiDyOptics, SceneGeometry
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


class Named(NamedTuple):
    image: Tensor
    depth: Tensor
    label: int


def pipeline(**options: object) -> OpticsPipeline:
    return OpticsPipeline(
        **{"geometry": K.RandomHorizontalFlip(p=1.0), "optics": RandomTiDyOptics(camera(sensor=None), p=1.0), **options}
    )


def lens_camera(**options: object) -> TiDyOptics:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(3))
    settings = Fidelity(window=17, layer_spacing=10.0, field_tolerance=1e-2)
    given = {"spectrum": Spectrum.monochrome(), "color_space": "linear", "fidelity": settings, **options}
    return TiDyOptics(masks, lens="single-50mm", **given)


def lens_scene() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    steps = torch.rand(1, 1, 10, 12, generator=generator).repeat_interleave(12, 2).repeat_interleave(12, 3)[..., :140]
    return torch.rand(1, 1, 120, 140, generator=generator), 1 / (0.2 + 3 * steps)


class TestOpticsPipeline(BaseTester):
    def test_smoke_without_arguments_it_is_the_camera(self):
        image, depth = scene(1)
        coded, same = OpticsPipeline()(image, depth)
        assert isinstance(OpticsPipeline().optics, TiDyOptics)
        assert coded.shape == image.shape
        assert torch.equal(same, depth)

    @pytest.mark.parametrize("batched", [True, False])
    @pytest.mark.parametrize("form", ["tensors", "tuple", "list", "named", "mapping", "mask_depth"])
    def test_cardinality_every_form_comes_back_as_it_was(self, form, batched):
        image, depth = scene(2) if batched else (x[0] for x in scene(1))
        expected = camera_of(chain := pipeline())(image.flip(-1), depth.flip(-1))
        if form == "tensors":
            coded, warped = chain(image, depth)
        elif form in ("tuple", "list", "named"):
            make = {"tuple": tuple, "list": list, "named": lambda parts: Named(*parts)}[form]
            out = chain(make((image, depth, 5)))
            assert type(out) is type(make((image, depth, 5)))
            assert out[2] == 5
            coded, warped = out[:2]
        else:
            name = "mask_depth" if form == "mask_depth" else "depth"
            out = chain({"image": image, name: depth, "label": 5, "name": "a"})
            assert set(out) == {"image", name, "label", "name", "all_in_focus"}
            assert torch.equal(out["all_in_focus"], image.flip(-1))
            coded, warped = out["image"], out[name]
        self.assert_close(coded, expected, rtol=0, atol=1e-6)
        assert torch.equal(warped, depth.flip(-1))

    def test_feature_holes_are_filled_and_masked(self):
        image, depth = scene(2)
        valid = depth > 0.5
        out = pipeline(geometry=K.RandomRotation((30.0, 30.0), p=1.0))({"image": image, "depth": depth, "mask": valid})
        assert (out["depth"] > 0).all()
        assert out["mask"].dtype == torch.bool
        assert (~out["mask"]).float().mean() > 0.05
        assert out["image"].isfinite().all()
        assert (out["depth"][out["mask"]] > 0.5).all()

    def test_feature_a_mask_of_classes_is_warped_and_stays_a_mask_of_classes(self):
        image, depth = scene(2)
        classes = (depth > 1).long()
        out = pipeline(geometry=K.RandomRotation((30.0, 30.0), p=1.0))(
            {"image": image, "depth": depth, "mask": classes}
        )
        assert out["mask"].dtype == torch.int64
        assert not out["mask_of_valid_depth"].all()

    def test_feature_boxes_and_other_masks_are_warped(self):
        image, depth = scene(2)
        points = torch.tensor([[[3.0, 4.0]]]).expand(2, -1, -1)
        out = pipeline()({"image": image, "depth": depth, "keypoints": points, "mask_people": depth})
        assert out["keypoints"][0, 0].tolist() == [image.shape[-1] - 1 - 3, 4]
        assert torch.equal(out["mask_people"], depth.flip(-1))

    @pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
    def test_feature_depth_stays_exact_whatever_the_image_is(self, kind):
        image, depth = scene(2)
        coded, warped = pipeline()(image.to(kind), depth)
        assert coded.dtype == kind
        assert torch.equal(warped, depth.flip(-1))

    def test_feature_photometry_comes_last(self):
        image, depth = scene(2)
        optics, invert = camera(sensor=None), K.RandomInvert(p=1.0)
        plain, inverted = (pipeline(optics=optics, photometry=last)(image, depth)[0] for last in (None, invert))
        self.assert_close(inverted, 1 - plain)

    def test_exception_parts(self):
        with pytest.raises(ValueError, match="photometry may not move pixels, got a RandomRotation"):
            OpticsPipeline(photometry=K.AugmentationSequential(K.RandomRotation(5.0)))
        with pytest.raises(ValueError, match="photometry may not move pixels, got a RandomTiDyOptics"):
            OpticsPipeline(photometry=RandomTiDyOptics(camera()))
        with pytest.raises(TypeError, match="optics must be TiDyOptics or an augmentation that reads depth"):
            OpticsPipeline(optics=K.RandomGaussianBlur((3, 3), (1.0, 2.0)))
        with pytest.raises(ValueError, match="border 'valid' crops the image and not the other"):
            OpticsPipeline(optics=camera(border="valid"))
        with pytest.raises(TypeError, match="augmentations of kornia that warp a mask"):
            OpticsPipeline(torch.nn.AvgPool2d(2))

    def test_exception_samples(self):
        image, depth = scene(1)
        with pytest.raises(KeyError, match="a mapping sample needs an 'image', and its depth under"):
            pipeline()({"image": image})
        with pytest.raises(ValueError, match="depth is missing"):
            pipeline()(image)
        with pytest.raises(ValueError, match=r"a tuple sample must be \(image, depth"):
            pipeline()((image,))
        with pytest.raises(ValueError, match="call it 'mask_normals'"):
            pipeline()({"image": image, "depth": depth, "normals": image})

    def test_feature_a_scene_geometry_is_taken_as_it_is(self):
        geometry = SceneGeometry(K.RandomHorizontalFlip(), scale_depth=True)
        assert OpticsPipeline(geometry).geometry is geometry


def camera_of(chain: OpticsPipeline) -> TiDyOptics:
    return chain.optics.optics


class TestBehindALens(BaseTester):
    @pytest.mark.parametrize(("random", "measured"), [(False, False), (True, False), (False, True), (True, True)])
    @torch.no_grad()
    def test_feature_a_crop_sees_what_the_whole_capture_has_there(self, random, measured):
        optics = lens_camera(field_center=(430.0, -500.0))
        optics.sensor = None
        if measured:
            places = [(0.0, 0.0), *((430.0 + y, -500.0 + x) for y in (-60, 0, 60) for x in (-70, 0, 70))]
            bank, optics.lens = optics.psf_bank(field=places), None
            optics = optics.with_bank(bank)
        whole = optics(*lens_scene())
        geometry = K.RandomCrop((64, 64))
        chain = OpticsPipeline(geometry, RandomTiDyOptics(optics, p=1.0) if random else optics)
        torch.manual_seed(5)
        image, depth = lens_scene()
        out = chain({"image": image, "depth": depth, "field_center": torch.tensor([430.0, -500.0])})
        top, left = (int(x) for x in chain.params["geometry"][0].data["src"][0, 0].flip(0))
        expected = whole[..., top : top + 64, left : left + 64]
        inner = slice(9, -9)  # where the window does not reach beyond the crop
        self.assert_close(out["image"][..., inner, inner], expected[..., inner, inner], rtol=0, atol=2e-3)
        place = torch.tensor([[430.0 + top + 31.5 - 59.5, -500.0 + left + 31.5 - 69.5]]).double()
        self.assert_close(out["field_center"], place, rtol=0, atol=1e-3)
        axis = optics(out["all_in_focus"], out["depth"], field_center=(0.0, 0.0))
        error = (axis - out["image"])[..., inner, inner].abs().max()
        assert float(error) > 0.02  # ten times the bound above
        again = chain(image, depth, params=chain.params)[0]
        assert torch.equal(again, out["image"])

    def test_feature_without_a_lens_nothing_is_told(self):
        image, depth = scene(1)
        assert set(pipeline()({"image": image, "depth": depth})) == {"image", "depth", "all_in_focus"}
