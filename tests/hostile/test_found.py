"""Damaged files that once ended in another error than a sentence; found by `make fuzz`."""

from __future__ import annotations

import json
import struct

import h5py
import numpy as np
import pytest

from kornia_tidy.data import NYUDepthV2, read_depth
from kornia_tidy.training.callbacks import drop_rows_after
from tests.base import BaseTester
from tests.data.published import write_nyu
from tests.mutations.readers import make_readers
from tests.mutations.reading import try_read

LONG = "a" * 5000


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    return make_readers(tmp_path_factory.mktemp("whole"))


def changed(**values):
    """Return what changes top entries of a JSON document."""
    return lambda data: json.dumps({**json.loads(data), **values}).encode()


def place(text):
    """Return what puts a place of a capture into an index."""
    return lambda data: b"key,name,clamped_pixels,coded\n000000,a,0," + text + b"\n"


FOUND = (
    ("index", "index.csv", place(b"00000.tar:%d:5" % 10**30), "a place must be a path"),  # OverflowError
    ("index", "index.csv", place(b"00000.tar:0:%d" % 10**14), "it has .* in all|there is no such file"),  # MemoryError
    ("index", "index.csv", place(b"00000.tar:1"), "a place must be a path"),
    ("index", "index.csv", place(b"/dev/zero:0:9"), "a place must be a path"),  # read outside of the folder
    ("index", "index.csv", place(b"../../etc/passwd"), "a place must be a path"),
    ("index", "index.csv", lambda data: data.replace(b"\n0", b",\n0,9,9,9,9", 1), "it is no index"),  # AttributeError
    ("index", "000000-000001.tar", lambda data: data[:700], "delete it to have it rendered again"),  # ReadError
    ("index", "000000-000001.tar", lambda data: data.replace(b"scene.json", b"other.json"), "delete it"),  # KeyError
    ("index", "sample.json", changed(index=float("inf")), "it has no scene.json of a capture"),  # OverflowError
    ("noise", "noise.json", changed(black=10**400, white=10**401), "is not a readable noise calibration"),
    ("noise", "noise.json", changed(**{LONG: 1}), "is not a readable noise calibration"),
    ("figure", "validation.csv", lambda data: data + bytes(200_000), "cannot read .*validation.csv"),  # csv.Error
    ("figure", "validation.csv", lambda data: data.replace(b"psnr", b"pxnr"), "logs of the run in .* are damaged"),
    ("folder", "rgb.txt", lambda data: data.replace(b"a.png", LONG.encode() + b".png"), "the name is too long"),
    ("tiff", "image.tif", lambda data: with_samples(data, 5), "5 samples a pixel, more than 4"),
)  # fmt: skip


def with_samples(data, samples):
    """Return a TIFF whose header tells of another number of samples a pixel."""
    entry = data.index(struct.pack("<HHI", 277, 3, 1))
    return data[: entry + 8] + struct.pack("<H", samples) + data[entry + 10 :]


class TestFound(BaseTester):
    @pytest.mark.parametrize(("kind", "name", "change", "sentence"), FOUND)
    def test_exception_is_a_sentence(self, kind, name, change, sentence, readers, tmp_path):
        name = {"000000-000001.tar": "00000.tar"}.get(name, name)
        cases = [case for case in readers[kind] if case.source.name == name]
        if name.endswith(".tar"):
            cases = [case for case in cases if case.damage == "tar"]
        assert cases
        for case in cases:
            result, said = try_read(case, change(case.source.read_bytes()), tmp_path)
            assert result == "refused", said
            self.assert_matches(sentence, said)

    @staticmethod
    def assert_matches(sentence, said):
        with pytest.raises(ValueError, match=sentence):
            raise ValueError(said)

    def test_feature_a_log_with_a_block_of_zeros_loses_that_line_alone(self, tmp_path):
        """As a power cut may leave it: a run could not be resumed."""
        path = tmp_path / "training.csv"
        path.write_bytes(b"epoch,step,loss\n0,5,0.5\n" + bytes(200_000) + b"\n0,10,0.45\n1,20,0.4\n0,\xff\n")
        drop_rows_after(path, 10)
        assert path.read_text().split() == ["epoch,step,loss", "0,5,0.5", "0,10,0.45"]

    @pytest.mark.parametrize("kind", ["external", "link", "soft link", "text", "virtual"])
    def test_exception_hdf5_reads_no_other_file(self, kind, tmp_path):
        """A depth map could show what its sender may not read."""
        secret, path = tmp_path / "secret.h5", tmp_path / "depth.h5"
        (tmp_path / "secret.bin").write_bytes(np.ones(16, "<f4").tobytes())
        with h5py.File(secret, "w") as file:
            file.create_dataset("dataset", data=np.ones((4, 4), "<f4"))
        with h5py.File(path, "w") as file:
            if kind == "external":
                file.create_dataset("dataset", (4, 4), "<f4", external=[(str(tmp_path / "secret.bin"), 0, 64)])
            elif kind == "link":
                file["dataset"] = h5py.ExternalLink(str(secret), "/dataset")
            elif kind == "soft link":
                file["dataset"] = h5py.SoftLink("/dataset")
            elif kind == "text":
                file.create_dataset("dataset", data=["a", "b"], dtype=h5py.string_dtype())
            else:
                layout = h5py.VirtualLayout((4, 4), "<f4")
                layout[:] = h5py.VirtualSource(secret, "dataset", (4, 4))
                file.create_virtual_dataset("dataset", layout)
        with pytest.raises(ValueError, match=r"in its HDF5 (is a link|lie in other files|must be numbers)"):
            read_depth(path)

    def test_exception_neither_does_nyu_depth(self, tmp_path):
        write_nyu(tmp_path, 1)
        path = tmp_path / "nyu_depth_v2_labeled.mat"
        path.rename(tmp_path / "other.mat")
        with h5py.File(path, "w") as file:
            for name in ("images", "depths"):
                file[name] = h5py.ExternalLink("other.mat", f"/{name}")
        with pytest.raises(ValueError, match=r"cannot read .*labeled\.mat: images in its HDF5 is a link"):
            NYUDepthV2(tmp_path, "all")
