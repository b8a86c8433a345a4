from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from kornia_tidy.arrays import cropped_image, depth_tensor, image_tensor, like_image
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


def codes(kind: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(kind).max + 1, (7, 9, 3)).astype(kind)


def images() -> dict[str, object]:
    small = codes()
    return {
        "uint8": small,
        "uint16": codes(np.uint16),
        "big endian": codes(np.uint16).astype(">u2"),
        "float": small / 255,
        "float32": (small / 255).astype(np.float32),
        "grey": small[..., 0],
        "batch": np.stack([small, small]),
        "read only": np.broadcast_to(small[:1], small.shape),
        "tensor": torch.from_numpy(small).permute(2, 0, 1),
        "tensor16": torch.from_numpy(codes(np.uint16)).permute(2, 0, 1),
        "half": torch.rand(3, 7, 9).half(),
        "PIL": Image.fromarray(small),
        "PIL grey": Image.fromarray(small[..., 0]),
    }


class TestImageTypes(BaseTester):
    @pytest.mark.parametrize("kind", list(images()))
    def test_feature_there_and_back_keeps_every_value(self, kind):
        image = images()[kind]
        tensor = image_tensor(image)
        assert tensor.shape[-2:] == (7, 9)
        assert tensor.shape[-3] == (1 if "grey" in kind else 3)
        assert tensor.min() >= 0
        assert tensor.max() <= 1
        back = like_image(tensor, image)
        assert type(back) is type(image) or (kind.startswith("PIL") and back.mode == image.mode)
        assert np.array_equal(np.asarray(back), np.asarray(image))
        if isinstance(image, np.ndarray):
            assert back.dtype == image.dtype

    def test_feature_values_of_whole_numbers(self):
        full = [np.full((1, 1), 255, np.uint8), np.full((1, 1), 65535, np.uint16), np.ones((1, 1), np.float32)]
        assert [float(image_tensor(x)) for x in full] == [1, 1, 1]
        over = like_image(torch.tensor([[[1.5, -0.5]]]), np.zeros((1, 2), np.uint8))
        assert over.tolist() == [[255, 0]]

    def test_feature_depth(self):
        millimetres = np.array([[500, 1500]], np.uint16)
        expected = torch.tensor([[[0.5, 1.5]]])
        for stored in (
            millimetres,
            millimetres[..., None],
            Image.fromarray(millimetres),
            torch.tensor([[[500, 1500]]]),
        ):
            self.assert_close(depth_tensor(stored, 0.001), expected)
        metres = torch.tensor([[[0.5]]], dtype=torch.float64)
        assert depth_tensor(metres) is metres

    @pytest.mark.parametrize("kind", ["uint8", "batch", "tensor", "PIL"])
    def test_cardinality_crop(self, kind):
        image = images()[kind]
        assert cropped_image(image, 0) is image
        assert image_tensor(cropped_image(image, 2)).shape[-2:] == (3, 5)

    def test_feature_masked_pixels_of_depth_are_holes_and_those_of_images_are_refused(self):
        depth = np.ma.masked_array(np.array([[500, 999999]], np.int32), mask=[[0, 1]], fill_value=999999)
        self.assert_close(depth_tensor(depth, 0.001), torch.tensor([[[0.5, 0.0]]]))
        assert torch.equal(image_tensor(np.ma.masked_array(codes())), image_tensor(codes()))
        with pytest.raises(ValueError, match=r"image must be known .* 1 of its 2 values are masked: fill them first"):
            image_tensor(np.ma.masked_equal(np.array([[3, 9]], np.uint8), 9))

    def test_exception(self):
        with pytest.raises(TypeError, match=r"image must be a tensor, a NumPy array or a PIL image, got 'a\.png'"):
            image_tensor("a.png")
        with pytest.raises(TypeError, match=r"floating-point, 8-bit or 16-bit numbers, got torch.int64"):
            image_tensor(torch.ones(3, 4, 4, dtype=torch.int64))
        with pytest.raises(ValueError, match=r"mode L, RGB or I;16, got RGBA: convert\('RGB'\)"):
            image_tensor(Image.new("RGBA", (4, 4)))
        with pytest.raises(ValueError, match=r"depth must be a PIL image in mode L, I;16, I or F, got RGBA$"):
            depth_tensor(Image.new("RGBA", (4, 4)))
        with pytest.raises(TypeError, match="image must hold numbers, got object"):
            image_tensor(np.array([[None]]))
        self.assert_close(depth_tensor(Image.new("I;16B", (1, 1), 700), 1e-3), torch.full((1, 1, 1), 0.7))
        with pytest.raises(ValueError, match=r"must be \(H, W\), \(H, W, C\) or \(B, H, W, C\), got \(4,\)"):
            image_tensor(np.zeros(4))
        with pytest.raises(ValueError, match="depth must have one channel, got 3"):
            depth_tensor(codes())
        with pytest.raises(ValueError, match="depth_scale must be positive"):
            depth_tensor(np.ones((2, 2)), 0)
        with pytest.raises(TypeError, match=r"depth must hold numbers, got torch.bool"):
            depth_tensor(torch.ones(1, 2, 2, dtype=torch.bool))


class TestAsTransform(BaseTester):
    @staticmethod
    def stored() -> tuple[np.ndarray, np.ndarray]:
        image, depth = scene(1)
        depth = (1000 * depth.clamp(max=5)).round()[0, 0].numpy().astype(np.uint16)
        return (image[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8), depth

    def expected(self, optics: torch.nn.Module) -> torch.Tensor:
        image, depth = self.stored()
        return optics(torch.from_numpy(image).permute(2, 0, 1) / 255, torch.from_numpy(depth)[None].float() / 1000)

    @pytest.mark.parametrize("kind", ["NumPy", "PIL", "uint8"])
    @pytest.mark.parametrize("form", ["mapping", "tuple", "lists"])
    def test_feature_images_of_any_type_in_any_form(self, kind, form):
        optics = camera(sensor=None)
        image, depth = self.stored()
        image = {"NumPy": image, "PIL": Image.fromarray(image), "uint8": torch.from_numpy(image).permute(2, 0, 1)}[kind]
        transform = optics.as_transform(image_key="rgb", depth_key="depth_map", depth_scale=0.001)
        if form == "tuple":
            coded, same, label = transform((image, depth, 3))
            assert label == 3
        else:
            given = {"rgb": image, "depth_map": depth, "label": 3}
            out = transform({name: [entry] for name, entry in given.items()} if form == "lists" else given)
            out = {name: entry[0] for name, entry in out.items()} if form == "lists" else out
            assert set(out) == {"rgb", "depth_map", "label", "all_in_focus"}
            assert out["all_in_focus"] is image
            coded, same = out["rgb"], out["depth_map"]
        assert same is depth
        assert type(coded) is type(image) or kind == "PIL"
        error = image_tensor(coded) - self.expected(optics)
        assert error.abs().max() <= 0.5001 / 255  # rounded once

    def test_feature_the_border_valid_crops_all_of_them(self):
        image, depth = self.stored()
        out = camera(border="valid").as_transform(depth_scale=0.001)(
            {"image": image, "depth": depth, "mask": depth > 0}
        )
        assert out["image"].shape == out["all_in_focus"].shape == (32, 40, 3)
        assert out["depth"].shape == out["mask"].shape == (32, 40)

    def test_exception(self):
        image, depth = self.stored()
        with pytest.raises(KeyError, match="needs an 'rgb', and its depth under 'z', got the keys"):
            camera().as_transform(image_key="rgb", depth_key="z")({"image": image, "depth": depth})
        with pytest.raises(ValueError, match="depth_scale must be positive"):
            camera().as_transform(depth_scale=-1.0)
        with pytest.raises(ValueError, match="depth must be positive metres, got 0"):
            camera().as_transform(depth_scale=0.001)({"image": image, "depth": depth * 0})
