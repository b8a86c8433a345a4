from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.augmentation import RandomDepthBlur, depth_blur
from tests.base import BaseTester

# Python 3.12 and later: every process that uses torch has threads, and fork says so.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


LENS = {"focus_distance": (0.6, 0.6), "f_number": (4.0, 4.0), "p": 1.0}


class TestAugmentationTransform(BaseTester):
    def sample(self):
        generator = torch.Generator().manual_seed(3)
        image = torch.randint(0, 256, (3, 40, 48), dtype=torch.uint8, generator=generator)
        millimetres = torch.randint(500, 3000, (40, 48), generator=generator)
        return image, millimetres

    @pytest.mark.parametrize("kind", ["tensors", "arrays of 8 bits", "arrays of 16 bits", "tuple", "floats"])
    def test_feature_is_the_function_for_samples_of_any_kind(self, kind):
        image, millimetres = self.sample()
        metres = millimetres[None] * 0.001
        transform = RandomDepthBlur(**LENS).as_transform(depth_scale=0.001)
        expected = depth_blur(image[None] / 255, metres[None], 0.6, 4.0)[0]
        batch = transform({"image": image[None] / 255, "depth": millimetres[None, None].to(torch.int32)})["image"]
        self.assert_close(batch, expected[None], atol=1e-6)
        if kind == "tensors":
            out = transform({"image": image, "depth": millimetres[None].to(torch.int32)})["image"] / 255
        elif kind == "tuple":
            out = transform((image, millimetres[None].to(torch.int32), "name"))[0] / 255
        elif kind == "floats":
            out = RandomDepthBlur(**LENS).as_transform()({"image": image / 255, "depth": metres})["image"]
        else:
            array = image.permute(1, 2, 0).numpy()
            array = array if "8" in kind else array.astype(np.uint16) * 257
            coded = transform({"image": array, "depth": millimetres.numpy().astype(np.uint16)})["image"]
            assert (coded.dtype, coded.shape) == (array.dtype, array.shape)
            out = torch.from_numpy(coded / np.iinfo(array.dtype).max).permute(2, 0, 1).float()
        assert out.shape == expected.shape
        self.assert_close(
            out, expected, rtol=0, atol=0.51 / 255 if kind in ("tensors", "tuple") or "8" in kind else 1e-5
        )

    def test_feature_an_item_has_its_draws_and_the_generator_of_torch_stays(self):
        image, millimetres = self.sample()
        transform = RandomDepthBlur(p=1.0).as_transform(seed=1, depth_scale=0.001)
        items = [{"image": image, "depth": millimetres[None].to(torch.int32), "index": n} for n in (0, 1, 0)]
        torch.manual_seed(5)
        before = torch.get_rng_state()
        first, other, again = (transform(item)["image"] for item in items)
        assert torch.equal(torch.get_rng_state(), before)
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_exception_whole_numbers(self):
        image, millimetres = self.sample()
        blur = RandomDepthBlur(**LENS)
        with pytest.raises(ValueError, match="depth_scale"):
            blur.as_transform()({"image": image, "depth": millimetres.numpy().astype(np.uint16)})
        with pytest.raises(TypeError, match=r"image must be floating point in \[0, 1\], got torch.uint8: divide it by"):
            blur(image, millimetres[None] * 0.001)
