"""What every data set keeps to: the sample's form, indices, errors, and workers that are forked or spawned."""

from __future__ import annotations

import multiprocessing

import pytest
import torch
from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip
from torch.utils.data import ConcatDataset, DataLoader, Subset

from kornia_tidy.data import (
    SUNRGBD,
    DeadLeaves,
    FlyingThings3D,
    NYUDepthV2,
    Patches,
    PhotoCollages,
    PhotographicLeaves,
    RGBDFolder,
    Scene,
    SceneDataset,
    TUMSequence,
    UnreadableItemError,
    photographs_in,
)
from tests.base import BaseTester
from tests.data.published import write_flying_things, write_frames, write_nyu

THINGS = {"kind": "disparity", "focal_px": 1050.0, "baseline_m": 1.0}
KINDS = {
    "dead leaves": lambda root: DeadLeaves(3, 40, 48, num_leaves=60),
    "photographic leaves": lambda root: PhotographicLeaves(3, 40, 48),
    "photo collages": lambda root: PhotoCollages(photographs_in(root / "frames_cleanpass"), 3, 40, 48),
    "flying things": FlyingThings3D,
    "nyu": lambda root: NYUDepthV2(root, "all"),
    "folder": lambda root: RGBDFolder(
        root, "frames_cleanpass/TRAIN/*/*/*/*.png", "disparity/TRAIN/*/*/*/*.pfm", **THINGS
    ),
    "tum": lambda root: TUMSequence(root / "tum"),
    "sun rgb-d": lambda root: SUNRGBD(root / "sun"),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """One data set of each kind."""
    root = tmp_path_factory.mktemp("data")
    write_flying_things(root, {"TRAIN/A": 2}, size=(32, 40))
    write_nyu(root, 3)
    write_frames(root / "tum", "rgb/{}.png", "depth/{}.png")
    write_frames(root / "sun", "{}/image/a.png", "{}/depth_bfx/b.png")
    for part in ("rgb", "depth"):
        (root / f"tum/{part}.txt").write_text("".join(f"{i} {part}/{i}.png\n" for i in range(3)))
    return {kind: make(root) for kind, make in KINDS.items()}


class Stub(SceneDataset):
    """Two scenes, of which the second cannot be read."""

    def __len__(self):
        return 2

    def name(self, index):
        return "ab"[index]

    def read(self, index):
        if index:
            raise ValueError("cannot read b.png: it is cut short")
        depth = torch.ones(1, 4, 5)
        return Scene(torch.full((1, 4, 5), 0.5), depth, depth > 0)


@pytest.mark.parametrize("kind", KINDS)
class TestEveryDataSet(BaseTester):
    def test_smoke_samples_have_one_form(self, data, kind):
        for number, sample in enumerate(data[kind]):
            assert list(sample) == ["image", "depth", "mask", "index", "name"]
            image, depth, mask = sample["image"], sample["depth"], sample["mask"]
            assert image.shape == (3, *depth.shape[1:])
            assert depth.shape == mask.shape == (1, *image.shape[1:])
            assert (image.dtype, depth.dtype, mask.dtype) == (torch.float32, torch.float32, torch.bool)
            assert image.is_contiguous()
            assert depth.is_contiguous()
            assert bool(((image >= 0) & (image <= 1)).all())
            assert bool((depth > 0).all())
            assert sample["index"] == number
            assert sample["name"] == data[kind].name(number)
        assert number + 1 == len(data[kind])

    def test_feature_items_are_the_same_whenever_they_are_read(self, data, kind):
        first = data[kind][1]
        torch.manual_seed(7)
        data[kind][0], data[kind][2]
        again = data[kind][1 - len(data[kind])]
        assert torch.equal(first["image"], again["image"])
        assert torch.equal(first["depth"], again["depth"])
        assert (first["index"], first["name"]) == (again["index"], again["name"])

    @pytest.mark.parametrize("beyond", [0, 5])
    def test_exception_index(self, data, kind, beyond):
        length = len(data[kind])
        for index in (length + beyond, -length - 1 - beyond):
            with pytest.raises(IndexError, match=f"item {index} of a data set of {length}"):
                data[kind][index]


class TestWorkers(BaseTester):
    # Python 3.12 and later: every process that uses torch has threads, and fork says so.
    @pytest.mark.takes_seconds
    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    @pytest.mark.parametrize(("context", "workers"), [("fork", 2), ("spawn", 1)])
    def test_feature_workers_read_the_same_bits(self, data, context, workers):
        if context not in multiprocessing.get_all_start_methods():
            pytest.skip(f"this system cannot {context}")
        data["nyu"][0]  # the parent has had the file open
        patches = Patches(ConcatDataset(list(data.values())), 32, count=30, seed=1)
        options = {"batch_size": 4, "multiprocessing_context": context, "timeout": 120}
        loaded = list(DataLoader(patches, num_workers=workers, **options))
        for batch, expected in zip(loaded, DataLoader(patches, batch_size=4), strict=True):
            assert batch["name"] == expected["name"]
            for key in ("image", "depth", "mask", "index"):
                assert torch.equal(batch[key], expected[key])

    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    def test_feature_training_may_skip_what_a_worker_cannot_read(self):
        loader = DataLoader(Subset(Stub(), [0, 1, 0]), num_workers=1, multiprocessing_context="fork", timeout=60)
        batches = iter(loader)
        assert next(batches)["name"] == ["a"]
        with pytest.raises(UnreadableItemError, match=r"item 1 of Stub, b: cannot read b\.png: it is cut short"):
            next(batches)
        assert [batch["name"] for batch in batches] == [["a"]]


class TestSceneDataset(BaseTester):
    def test_convention_kornia_warps_depth_under_the_name_of_a_mask(self):
        batch = next(iter(DataLoader(DeadLeaves(2, 12, 16, num_leaves=20), batch_size=2)))
        renamed = {"mask_depth" if key == "depth" else key: value for key, value in batch.items()}
        warp = AugmentationSequential(RandomHorizontalFlip(p=1.0), data_keys=None)
        warped = warp(renamed)
        for key in ("image", "mask", "mask_depth"):
            assert warped[key].dtype == renamed[key].dtype
            assert torch.equal(warped[key], renamed[key].flip(-1))
        assert torch.equal(warp(batch)["depth"], batch["depth"])  # the trap of which the documentation tells

    def test_feature_transform_gets_the_sample(self):
        assert Stub(transform=lambda sample: (sample["name"], sample["index"]))[0] == ("a", 0)

    def test_feature_errors_of_the_transform_are_its_own(self):
        def refuse(sample):
            raise ValueError("not this one")

        with pytest.raises(ValueError, match=r"^not this one$") as caught:
            Stub(transform=refuse)[0]
        assert not isinstance(caught.value, UnreadableItemError)

    def test_feature_grey_is_repeated(self):
        assert torch.equal(Stub()[0]["image"], torch.full((3, 4, 5), 0.5))

    @pytest.mark.parametrize("index", [torch.tensor(0), -2, False])
    def test_feature_whatever_is_an_index_will_do(self, index):
        sample = Stub()[index]
        assert sample["index"] == 0
        assert type(sample["index"]) is int

    def test_exception_what_is_no_index(self):
        with pytest.raises(TypeError):
            Stub()[0.0]

    def test_exception_names_item_and_file_and_keeps_the_cause(self):
        with pytest.raises(UnreadableItemError, match=r"^item 1 of Stub, b: cannot read b\.png") as caught:
            Stub()[-1]
        assert isinstance(caught.value.__cause__, ValueError)
        assert isinstance(caught.value, ValueError)
