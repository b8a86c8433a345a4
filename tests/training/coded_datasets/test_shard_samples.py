"""Samples of shards that the command wrote, as WebDataset reads them: equal to those of CodedCaptures."""

from __future__ import annotations

import tarfile
import warnings

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import UnreadableItemError
from kornia_tidy.training.coded_datasets import CodedCaptures, decode_sample
from tests.base import BaseTester

FORMS = {"png": [], "float": ["--float"], "few": ["--beside", "depth"]}


@pytest.fixture(scope="module", params=FORMS, ids=str)
def folder(request, tmp_path_factory):
    """Five captures in three shards, written by `kornia-tidy render`."""
    folder = tmp_path_factory.mktemp(request.param)
    options = ["--scenes", "5", "--size", "48", "--masks", "1", "--shard-items", "2"]
    assert main(["render", *options, *FORMS[request.param], "-o", str(folder)]) == 0
    return folder


def samples_of(shard):
    """The samples of a tar file, grouped as WebDataset does it: by the part of the name before the first dot."""
    samples = {}
    with tarfile.open(shard) as file:
        for member in file:
            key, _, name = member.name.partition(".")
            sample = samples.setdefault(key, {"__key__": key, "__url__": str(shard)})
            sample[name] = file.extractfile(member).read()
    return list(samples.values())


def assert_same(found, expected):
    assert list(map(sorted, found)) == list(map(sorted, expected))
    for one, other in zip(found, expected, strict=True):
        for name, value in other.items():
            assert torch.equal(one[name], value) if isinstance(value, torch.Tensor) else one[name] == value, name


class TestDecodeSample(BaseTester):
    def test_feature_the_items_of_coded_captures(self, folder):
        found = [decode_sample(sample) for shard in sorted(folder.glob("*.tar")) for sample in samples_of(shard)]
        assert_same(found, list(CodedCaptures(folder)))
        assert found[0]["depth"].shape == (1, 48, 48)

    def test_feature_images_keep_sixteen_bits(self, folder):
        shard = next(folder.glob("*.tar"))
        sample = samples_of(shard)[0]
        if "coded.png" in sample:
            steps = decode_sample(sample)["coded"].unique().mul(65535)
            assert steps.numel() > 256
            self.assert_close(steps, steps.round(), rtol=0, atol=0.01)

    def test_feature_webdataset_in_one_line(self, folder):
        webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed")
        shards = sorted(map(str, folder.glob("*.tar")))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its own
            data = webdataset.WebDataset(shards, shardshuffle=False).map(decode_sample)
            found = list(data)
            assert [sample.pop("__key__") for sample in found] == [f"{i:06d}" for i in range(5)]  # map() adds it
            assert_same(found, list(CodedCaptures(folder)))
            batch = next(iter(torch.utils.data.DataLoader(data, batch_size=5)))
        assert batch["coded"].shape == (5, 3, 48, 48)
        assert batch["index"].tolist() == [0, 1, 2, 3, 4]

    def test_feature_other_files_of_a_sample_are_passed_on(self, folder):
        sample = samples_of(next(folder.glob("*.tar")))[0]
        assert decode_sample({**sample, "label.cls": b"3"})["label.cls"] == b"3"

    def test_exception_samples_that_are_damaged_or_no_capture(self, folder):
        sample = samples_of(sorted(folder.glob("*.tar"))[0])[0]
        picture = next(name for name in sample if name.startswith("coded"))
        for change, sentence in (
            ({picture: sample[picture][:50]}, rf"00000\.tar, capture 000000, {picture}"),
            ({"scene.json": b"{}"}, r"cannot read .*00000\.tar, capture 000000: it has no scene\.json of a capture"),
            ({"scene.json": b"["}, r"it has no scene\.json of a capture, or it is damaged"),
        ):
            with pytest.raises(UnreadableItemError, match=sentence) as error:
                decode_sample({**sample, **change})
            assert "\n" not in str(error.value)
        with pytest.raises(UnreadableItemError, match="it has no coded image, only __key__"):
            decode_sample({name: value for name, value in sample.items() if name != picture})
