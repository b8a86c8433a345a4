"""Files that other systems leave beside pictures: macOS's "._name", ".DS_Store" and __MACOSX, Windows' Thumbs.db."""

from __future__ import annotations

import shutil

import pytest

from kornia_tidy.data import (
    SUNRGBD,
    FlyingThings3D,
    RGBDFolder,
    hypersim,
    kitti,
    middlebury,
    photographs_in,
    scannet,
    seven_scenes,
)
from kornia_tidy.data.image_files import SUFFIXES
from kornia_tidy.files import find_files
from tests.base import BaseTester
from tests.data.published import write_each

APPLE_DOUBLE = b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(60)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """One or two scenes of each published data set, and a copy with the files that other systems leave."""
    plain, littered = (tmp_path_factory.mktemp("published") / name for name in ("plain", "littered"))
    plain.mkdir()
    write_each(plain)
    shutil.copytree(plain, littered)
    for path in sorted(plain.rglob("*")):
        beside = littered / path.relative_to(plain)
        beside.with_name(f"._{beside.name}").write_bytes(APPLE_DOUBLE)
        if path.is_dir():
            for name in (".DS_Store", "Thumbs.db", "@eaDir/a.png"):
                (beside / name).parent.mkdir(exist_ok=True)
                (beside / name).write_bytes(b"\0\0\0\1Bud1")
    for root in [path for path in littered.iterdir() if path.is_dir()]:  # as an archive packed by macOS unpacks
        for path in [path for path in root.rglob("._*") if "__MACOSX" not in path.parts]:
            copied = root / "__MACOSX" / path.relative_to(root)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, copied)
    return plain, littered


OPEN = {
    "flyingthings3d": FlyingThings3D,
    "chess": seven_scenes,
    "scans": scannet,
    "SUNRGBD": SUNRGBD,
    "val_selection_cropped": kitti,
    "middlebury2014": middlebury,
    "hypersim": hypersim,
    "rgbd_dataset_freiburg1_desk": lambda root: RGBDFolder(root, "rgb/*", "depth/*"),
}


class TestHiddenFiles(BaseTester):
    @pytest.mark.parametrize("name", OPEN)
    def test_feature_data_sets_pass_them_by(self, published, name):
        scenes = [OPEN[name](root / name) for root in published]
        names = [[data.name(index) for index in range(len(data))] for data in scenes]
        assert names[0] == names[1]
        if name != "hypersim":  # whose frames here are too small to be read
            assert [sample["name"] for sample in scenes[1]] == names[0]

    def test_feature_photographs_pass_them_by(self, published):
        plain, littered = published
        found = [path.relative_to(littered) for path in photographs_in(littered)]
        assert found == sorted(p.relative_to(plain) for p in plain.rglob("*") if p.suffix in SUFFIXES)

    def test_feature_a_dot_in_the_pattern_finds_them_as_in_a_shell(self, tmp_path):
        for name in (".cache/a.png", "seen/.a.png", "seen/b.png"):
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).touch()
        for pattern, expected in (("*/*.png", ["b.png"]), (".cache/*.png", ["a.png"]), ("*/.*.png", [".a.png"])):
            assert [path.name for path in find_files(tmp_path, pattern)] == expected
