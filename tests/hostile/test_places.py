"""Places of files: odd names, read-only folders, full disks, links, pipes and several writers of one file."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest

from kornia_tidy import PixelwiseMask
from kornia_tidy.data import dead_leaves, read_image, write_depth, write_image
from kornia_tidy.files import write_bytes, write_folder
from kornia_tidy.lab.mask_export import write_heights
from tests.base import BaseTester
from tests.forks import fork, wait
from tests.hostile.limited import apart, command, drop_rights, limit_files
from tests.lab.raw.dng import dng

pytestmark = pytest.mark.usefixtures("one_thread")
NAMES = (
    "with blanks  in it.png", "Übermaß 图像 🎉.png", "e\u0301.png", "a\nb\tc.png", "a'b\"c$(d)*?[e].png",
    "a" * 251 + ".png", os.fsdecode(b"not-utf-8-\xff.png"), "-leading.png", ".hidden.png", "..png",
)  # fmt: skip
SMALL = ("--masks", "1", "--fidelity", "draft")
SIMULATE = ("simulate", "./in.png", "--depth", "in.pfm", "-o", "out.png", *SMALL)
RENDER = ("render", "--data", "dead-leaves", "--size", "32", "--scenes", "2", "-o", "out", *SMALL)
WRITERS = {
    "simulate": SIMULATE,
    "render": RENDER,
    "render shards": (*RENDER, "--shard-items", "2"),
    "masks export": ("masks", "export", "masks.npy", "-o", "slm", "--panel", "64x64"),
    "masks heights": ("masks", "export", "masks.npy", "-o", "out.npy"),
    "psf": ("psf", "masks.npy", "-o", "out.png"),
    "develop": ("raw", "develop", "in.dng", "-o", "out"),
    "raw simulate": ("raw", "simulate", "--image", "in.png", "--depth", "in.pfm", "-o", "out.dng"),
    "train": ("train", "--data", "dead-leaves", "--size", "32", "--scenes", "1", "--validation-scenes", "1",
              "--epochs", "1", "--masks", "1", "--batch", "1", "-o", "out"),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """Return a folder with a scene, masks and a raw file, in which a command works."""
    place = tmp_path / "work"
    place.mkdir()
    image, depth = dead_leaves(48, 48, num_leaves=20, seed=0)
    write_image(place / "in.png", image)
    write_depth(place / "in.pfm", depth)
    write_heights(place / "masks.npy", PixelwiseMask(1).heights().detach())
    (place / "in.dng").write_bytes(dng(np.random.default_rng(0).integers(64, 999, (32, 48)).astype(np.uint16)))
    return place


def refused(outcome):
    """Check that a command ended with status 2 and one sentence, and return that."""
    errors = [line for line in outcome.told.splitlines() if line.startswith("kornia-tidy: error: ")]
    assert outcome.status == 2, outcome
    assert len(errors) == 1, outcome
    assert "Traceback" not in outcome.told
    return errors[0]


def fill_disk(kind, folder):
    """Check that a command whose files find no room says so, and leaves no half file."""
    before = sorted(os.listdir(folder))
    outcome = command(WRITERS[kind], Path(folder), lambda: limit_files(2000))
    assert "File too large" in refused(outcome)
    left = [path for path in Path(folder).rglob("*") if path.name not in before and path.is_file()]
    assert not [path for path in left if path.suffix in {".tmp", ".png", ".npy", ".dng", ".tar"}], left


class TestNames(BaseTester):
    @pytest.mark.parametrize("name", NAMES, ids=ascii)
    def test_feature_any_name_is_read_and_written(self, name, folder):
        (folder / "there").mkdir()
        (folder / "in.png").rename(folder / name)
        argv = [word.replace("./in.png", f"./{name}").replace("out.png", f"there/{name}") for word in SIMULATE]
        outcome = command(argv, folder)
        assert outcome.status == 0, outcome
        assert outcome.told == ""
        assert os.listdir(folder / "there") == [name]
        assert read_image(folder / "there" / name).shape == (3, 48, 48)


class TestDisks(BaseTester):
    @pytest.mark.parametrize("kind", [name for name in WRITERS if name not in {"psf", "train"}])
    def test_exception_a_full_disk_leaves_no_half_file(self, kind, folder):
        fill_disk(kind, folder)

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["psf", "train"])
    def test_exception_a_full_disk_leaves_no_half_file_of_slow_commands(self, kind, folder):
        pytest.importorskip("lightning.pytorch")
        apart(fill_disk, kind, str(folder))

    @pytest.mark.parametrize("kind", ["render", "render shards", "masks export", "masks heights", "develop"])
    def test_exception_a_read_only_folder(self, kind, folder):
        folder.chmod(0o555)
        before = sorted(os.listdir(folder))
        outcome = command(WRITERS[kind], folder, drop_rights)
        folder.chmod(0o755)
        assert "ermission denied" in refused(outcome)
        assert sorted(os.listdir(folder)) == before

    @pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no device that is full")
    def test_exception_a_device_is_not_replaced(self, folder):
        """A renamed file would take the place of the device, for all who use it."""
        device = os.stat("/dev/full")
        (folder / "out.png").symlink_to("/dev/full")
        assert "it is not a regular file" in refused(command(SIMULATE, folder))
        assert (folder / "out.png").is_symlink()
        assert os.stat("/dev/full").st_rdev == device.st_rdev

    def test_exception_pipes_and_sockets_are_neither_read_nor_replaced(self, folder, monkeypatch):
        monkeypatch.chdir(folder)
        os.mkfifo("pipe.png")
        with socket.socket(socket.AF_UNIX) as server:
            server.bind("socket.png")
            for name in ("pipe.png", "socket.png"):
                for word in ("./in.png", "out.png"):
                    told = refused(command([name if part == word else part for part in SIMULATE], folder))
                    assert f"{name}: it is not a regular file" in told
                assert (folder / name).exists()
                assert not (folder / name).is_file()


class TestLinks(BaseTester):
    def test_convention_a_link_is_replaced_and_what_it_leads_to_is_left_alone(self, folder):
        for name, target in (("out.png", "in.png"), ("loop.png", "loop.png"), ("nowhere.png", "nothing/x.png")):
            (folder / name).unlink(missing_ok=True)
            (folder / name).symlink_to(target)
        whole = (folder / "in.png").read_bytes()
        assert "it is an input" in refused(command(SIMULATE, folder))
        shutil.copy(folder / "in.png", folder / "other.png")
        (folder / "out.png").unlink()
        (folder / "out.png").symlink_to("other.png")
        for name in ("out.png", "loop.png", "nowhere.png"):
            outcome = command([word.replace("out.png", name) for word in SIMULATE], folder)
            assert outcome.status == 0, outcome
            assert not (folder / name).is_symlink()
            assert read_image(folder / name).shape == (3, 48, 48)
        assert (folder / "other.png").read_bytes() == (folder / "in.png").read_bytes() == whole


class TestWriters(BaseTester):
    def test_feature_a_file_with_several_writers_is_whole_at_any_time(self, tmp_path):
        path = tmp_path / "shared.bin"

        def write(letter):
            for _ in range(60):
                write_bytes(path, letter * 200_000)

        write_bytes(path, b"a" * 200_000)
        writers = [fork(lambda letter=letter: write(letter)) for letter in (b"b", b"c", b"d")]
        for _ in range(200):
            data = path.read_bytes()
            assert data == data[:1] * 200_000
        assert [wait(writer) for writer in writers] == [0, 0, 0]
        assert os.listdir(tmp_path) == ["shared.bin"]

    def test_feature_a_folder_with_several_writers_is_of_one_of_them(self, tmp_path):
        def write(letter):
            for _ in range(30):
                try:
                    write_folder(tmp_path / "shared", {"1": letter * 9999, "2": letter * 9999}, replace=True)
                except OSError:
                    continue  # another was faster: nothing is lost, and nothing is left

        writers = [fork(lambda letter=letter: write(letter)) for letter in (b"b", b"c", b"d")]
        assert [wait(writer) for writer in writers] == [0, 0, 0]
        assert os.listdir(tmp_path) == ["shared"]
        one, other = ((tmp_path / "shared" / name).read_bytes() for name in "12")
        assert one == other == one[:1] * 9999
