from __future__ import annotations

import pytest
import torch

from tests.augmentation.optional import need_torchvision

need_torchvision()

import numpy as np  # noqa: E402
from PIL import Image as PILImage  # noqa: E402
from torch.utils.data import DataLoader, Dataset  # noqa: E402
from torchvision import tv_tensors  # noqa: E402
from torchvision.transforms import v2  # noqa: E402

from kornia_tidy.augmentation.torchvision_v2 import Depth, OpticsTransform, Valid  # noqa: E402
from kornia_tidy.data import Scene  # noqa: E402
from tests.base import BaseTester  # noqa: E402
from tests.camera.pipeline_samples import camera, scene  # noqa: E402


def sample(batch: int | None = None) -> dict[str, torch.Tensor]:
    image, depth = scene(batch or 1)
    image, depth = (image, depth) if batch else (image[0], depth[0])
    return {"image": tv_tensors.Image(image), "depth": Depth(depth)}


def plain(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.as_subclass(torch.Tensor)


class TestDepth(BaseTester):
    @pytest.mark.parametrize(
        "transform",
        [
            v2.RandomHorizontalFlip(1.0),
            v2.RandomVerticalFlip(1.0),
            v2.RandomCrop((20, 24)),
            v2.CenterCrop((20, 24)),
            v2.RandomResizedCrop((20, 24)),
            v2.Resize((20, 24)),
            v2.RandomRotation((20, 20), fill=0.5),
            v2.RandomAffine((20, 20), fill=0.5),
            v2.RandomPerspective(p=1.0, fill=0.5),
            v2.ElasticTransform(fill=0.5),
            v2.Pad(3, fill=0.5),
            v2.RandomZoomOut(fill=0.5, p=1.0),
            v2.RandomShortestSize((20,)),
            v2.ScaleJitter((30, 30)),
        ],
        ids=lambda transform: type(transform).__name__,
    )
    def test_feature_every_warp_takes_the_nearest_depth_and_leaves_zero_beyond_the_image(self, transform):
        given = sample()
        out = transform(given)
        assert isinstance(out["depth"], Depth)
        assert out["depth"].shape[-2:] == out["image"].shape[-2:]
        values = plain(out["depth"])
        assert torch.isin(values, torch.cat([plain(given["depth"]).flatten(), torch.zeros(1)])).all()


class TestOpticsTransform(BaseTester):
    @pytest.mark.parametrize("kind", [torch.uint8, torch.float16, torch.bfloat16, torch.float32, torch.float64])
    def test_smoke(self, kind):
        image = v2.functional.to_dtype(sample()["image"], kind, scale=True)
        out = OpticsTransform(camera())({"image": image, "depth": sample()["depth"]})
        assert out["image"].dtype == kind
        assert out["depth"].dtype == torch.float32
        assert plain(out["image"]).double().isfinite().all()

    @pytest.mark.parametrize("channels", [1, 3])
    @pytest.mark.parametrize("lead", [(), (1,), (3,)])
    def test_cardinality(self, lead, channels):
        image, depth = torch.rand(*lead, channels, 40, 48), torch.ones(*lead, 1, 40, 48)
        coded, kept = OpticsTransform(camera())(tv_tensors.Image(image), Depth(depth))
        assert (coded.shape, kept.shape) == (image.shape, depth.shape)

    @pytest.mark.parametrize("batch", [None, 2])
    def test_feature_flip_optics_crop_equals_the_manual_chain(self, batch):
        optics, given = camera(sensor=None), sample(batch)
        chain = v2.Compose([v2.RandomHorizontalFlip(1.0), OpticsTransform(optics), v2.CenterCrop((20, 24))])
        out = chain(given)
        image, depth = (plain(given[name]).flip(-1) for name in ("image", "depth"))
        self.assert_close(plain(out["image"]), optics(image, depth)[..., 10:30, 12:36], rtol=0, atol=1e-6)
        assert torch.equal(plain(out["depth"]), depth[..., 10:30, 12:36])

    @pytest.mark.parametrize("kind", ["Image", "uint8", "PIL", "tensor", "Video"])
    def test_feature_images_come_back_as_what_they_came(self, kind):
        optics, (image, depth) = camera(sensor=None), scene(2)
        codes = (image[0] * 255).round().byte()
        given = {
            "Image": tv_tensors.Image(image[0]),
            "uint8": tv_tensors.Image(codes),
            "PIL": PILImage.fromarray(codes.permute(1, 2, 0).numpy()),
            "tensor": image[0],
            "Video": tv_tensors.Video(image),
        }[kind]
        wrapped = Depth(depth if kind == "Video" else depth[0])
        out, same = OpticsTransform(optics)(given, wrapped)
        assert type(out) is type(given) or kind == "PIL"
        assert isinstance(same, Depth)
        expected = optics(image, depth) if kind == "Video" else optics(image[0], depth[0])
        if kind in ("uint8", "PIL"):
            codes_out = torch.from_numpy(np.array(out)).permute(2, 0, 1) if kind == "PIL" else plain(out)
            assert codes_out.dtype == torch.uint8
            # Half a level of rounding in, half a level out: encoded light changes by less than its input may.
            assert (codes_out / 255 - optics(codes / 255, depth[0])).abs().max() <= 0.5001 / 255
        else:
            self.assert_close(plain(out) if isinstance(out, torch.Tensor) else out, expected)

    def test_feature_random_apply_keeps_one_set_of_keys(self):
        chain = v2.RandomApply([OpticsTransform(camera())], p=0.5)
        given = {**sample(), "label": 3, "mask": tv_tensors.Mask(torch.ones(40, 48))}
        outs = [chain(given) for _ in range(12)]
        assert {tuple(out) for out in outs} == {("image", "depth", "label", "mask")}
        taken = {torch.equal(plain(out["image"]), plain(given["image"])) for out in outs}
        assert taken == {True, False}

    def test_feature_the_mask_of_holes_is_false_beyond_the_image_whatever_the_fill(self):
        given = sample()
        given["depth"][:, 8:14, 20:30] = 0
        chain = [
            OpticsTransform(camera(), holes="fill"),
            v2.RandomHorizontalFlip(1.0),
            v2.RandomRotation((30, 30), fill=1),
        ]
        out = v2.Compose(chain)(given)
        assert isinstance(out["valid"], Valid)
        assert torch.equal(plain(out["valid"]), plain(v2.Compose(chain[1:])(given)["depth"]) > 0)

    def test_feature_the_mask_comes_beside_the_depth_wherever_that_stands(self):
        image, depth = scene(1)
        depth[..., 3:9, 3:9] = torch.nan
        transform, known = OpticsTransform(camera(), holes="fill"), depth > 0
        _, target = transform(tv_tensors.Image(image), {"depth": Depth(depth), "label": 3})
        assert torch.equal(plain(target["valid"]), known)
        out = transform(Scene(tv_tensors.Image(image), Depth(depth), None))
        assert torch.equal(plain(out.valid), known)
        assert isinstance(out.depth, Depth)
        assert len(transform(tv_tensors.Image(image), Depth(depth))) == 2

    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    def test_feature_in_the_workers_of_a_data_loader(self):
        loader = DataLoader(Samples(), batch_size=2, num_workers=2, multiprocessing_context="fork", timeout=60)
        batch = next(iter(loader))
        assert batch["image"].shape == (2, 3, 40, 48)
        assert torch.equal(plain(batch["depth"]), scene(2)[1].flip(-1))

    def test_exception(self):
        image, depth = scene(1)
        transform = OpticsTransform(camera())
        with pytest.raises(ValueError, match=r"one Depth for its images, got 0: wrap the map as Depth\(depth\)"):
            transform(tv_tensors.Image(image), depth)
        with pytest.raises(ValueError, match="must hold an image beside its Depth"):
            transform(Depth(depth))
        with pytest.raises(ValueError, match="border 'valid' crops"):
            OpticsTransform(camera(border="valid"))


class Samples(Dataset):
    chain = v2.Compose([v2.RandomHorizontalFlip(1.0), OpticsTransform(camera())])

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        image, depth = (x[index] for x in scene(2))
        return self.chain({"image": tv_tensors.Image(image), "depth": Depth(depth)})
