from __future__ import annotations

import json
import shutil
import tarfile

import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.data import RGBDFolder
from kornia_tidy.training.coded_datasets import CodedCaptures, Layout, Rendered, render_scenes, shard_items_within
from tests.base import BaseTester
from tests.training.coded_datasets.samples import RandomScenes, contents, small_camera, small_scenes

FORMS = [Layout(), Layout(shard_items=2)]


@pytest.fixture(scope="module", params=FORMS, ids=["folders", "shards"])
def whole(request, tmp_path_factory):
    """Five captures by one process, and their layout."""
    folder = tmp_path_factory.mktemp("whole")
    assert render_scenes(small_camera(), small_scenes(), folder, request.param, seed=7) == Rendered(5, 0)
    return folder, request.param


class TestRenderScenes(BaseTester):
    def test_feature_a_capture_is_what_the_camera_as_a_transform_gives(self, whole):
        folder, _ = whole
        captures = CodedCaptures(folder)
        optics = small_camera()
        transform = optics.as_transform(seed=7)
        for index, scene in enumerate(small_scenes()):
            expected, got = transform(scene), captures[index]
            self.assert_close(got["coded"], expected["image"], rtol=0, atol=0.5 / 65535 + 1e-7)
            self.assert_close(got["image"], scene["image"], rtol=0, atol=0.5 / 65535 + 1e-7)
            assert torch.equal(got["depth"], scene["depth"])
            assert torch.equal(got["mask"], scene["mask"])
            assert (got["index"], got["name"]) == (index, scene["name"])

    @pytest.mark.parametrize("world", [2, 3])
    def test_feature_processes_that_share_the_work_give_the_same_bytes(self, whole, world, tmp_path):
        folder, layout = whole
        made = [
            render_scenes(small_camera(), small_scenes(), tmp_path, layout, seed=7, rank=rank, world=world).made
            for rank in range(world)
        ]
        assert sum(made) == 5
        assert min(made) > 0
        assert contents(tmp_path) == contents(folder)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("jobs", [1, 2])
    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    def test_feature_a_process_takes_over_what_others_have_not_written(self, whole, jobs, tmp_path):
        folder, layout = whole
        first = render_scenes(small_camera(), small_scenes(), tmp_path, layout, seed=7, rank=2, world=3)
        rest = render_scenes(
            small_camera(), small_scenes(), tmp_path, layout, seed=7, rank=0, world=3, jobs=jobs, take_over=True
        )
        assert 0 < first.made < 5
        assert rest == (5 - first.made, 0)
        assert contents(tmp_path) == contents(folder)

    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    @pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")
    def test_feature_so_do_jobs(self, whole, tmp_path):
        folder, layout = whole
        assert render_scenes(small_camera(), small_scenes(), tmp_path, layout, seed=7, jobs=2).made == 5
        assert contents(tmp_path) == contents(folder)

    def test_feature_what_is_there_is_left_and_what_is_missing_is_made_again(self, whole, tmp_path):
        folder, layout = whole
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        gone = tmp_path / layout.parts(5)[1].name
        shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
        (tmp_path / "index.csv").unlink()
        (tmp_path / f".{'0' * 32}.tmp").mkdir()  # as a process leaves it that is killed
        kept = tmp_path / layout.parts(5)[0].name
        touched = kept.stat().st_mtime_ns
        again = render_scenes(small_camera(), small_scenes(), tmp_path, layout, seed=7)
        assert again == Rendered(len(layout.parts(5)[1].items), 5 - len(layout.parts(5)[1].items))
        assert kept.stat().st_mtime_ns == touched
        assert contents(tmp_path) == contents(folder)
        assert not list(tmp_path.glob(".*"))

    def test_feature_scenes_of_tensors_that_draw_at_random(self, tmp_path):
        """Without mask or name, drawn from the global generator: the same whoever renders which, and nobody's draws."""
        torch.manual_seed(5)
        expected = torch.rand(1)
        torch.manual_seed(5)
        with pytest.warns(UserWarning, match="beyond the camera's range"):
            render_scenes(small_camera(), RandomScenes(), tmp_path / "one", Layout(shard_items=3))
        assert torch.equal(torch.rand(1), expected)
        for rank in (2, 1, 0):
            camera = small_camera(check_inputs=False)
            render_scenes(camera, RandomScenes(), tmp_path / "three", Layout(shard_items=1), rank=rank, world=3)
        one, three = CodedCaptures(tmp_path / "one"), CodedCaptures(tmp_path / "three")
        for a, b in zip(one, three, strict=True):
            assert all(torch.equal(a[key], b[key]) for key in ("coded", "image", "depth", "mask"))
        assert one.name(2) == "000002"
        rows = (tmp_path / "one" / "index.csv").read_text().splitlines()
        assert [row.split(",")[:3] for row in rows] == [
            ["key", "name", "clamped_pixels"],
            ["000000", "000000", "0"],
            ["000001", "000001", "64"],
            ["000002", "000002", "0"],
        ]

    def test_feature_render_json_tells_masks_to_the_last_digit(self, whole):
        about = json.loads((whole[0] / "render.json").read_text(), parse_constant=pytest.fail)
        heights = torch.tensor(about["heights_m"])
        assert torch.equal(heights, small_camera().masks.heights())
        assert about["camera"]["aperture_diameter"] == 2.835e-3
        assert about["camera"]["depth_range"] == [0.2975, "inf"]
        assert (about["noise_seed"], about["captures"], about["sensor"]["sigma"]) == (7, 5, 0.01)


class TestShards(BaseTester):
    def test_feature_a_shard_is_what_webdataset_reads(self, tmp_path):
        """A plain tar file whose members of one item follow each other and share the name up to the first dot."""
        render_scenes(small_camera(), small_scenes(), tmp_path, Layout(shard_items=2))
        keys = []
        for path in sorted(tmp_path.glob("*.tar")):
            with tarfile.open(path) as shard:
                members = shard.getmembers()
                assert all((m.isreg(), m.mtime, m.uid, m.uname) == (True, 0, 0, "") for m in members)
                names = [m.name.split(".", 1) for m in members]
                keys += [name[0] for name in names]
                assert [n[1] for n in names[:5]] == ["coded.png", "image.png", "depth.npy", "mask.png", "scene.json"]
                assert shard.extractfile(f"{names[0][0]}.coded.png").read(4) == b"\x89PNG"
        assert keys == [f"{i:06d}" for i in range(5) for _ in range(5)]

    @pytest.mark.parametrize("room", [1, 60_000, 200_000])
    def test_feature_a_size_in_bytes_is_kept_where_captures_are_alike(self, room, tmp_path):
        scenes, optics = torch.utils.data.Subset(small_scenes(), [0] * 8), small_camera(sensor=SensorNoise(0.0))
        items = shard_items_within(optics, scenes, Layout(), room)
        render_scenes(optics, scenes, tmp_path, Layout(shard_items=items))
        sizes = [path.stat().st_size for path in sorted(tmp_path.glob("*.tar"))]
        end = tarfile.RECORDSIZE  # an empty shard has as much
        assert items == 1 or max(sizes) <= room + end
        assert len(sizes) == 1 or room < sizes[0] * (items + 1) / items


class TestFolders(BaseTester):
    def test_feature_the_data_set_of_rgbd_folders_reads_them(self, tmp_path):
        render_scenes(small_camera(), small_scenes(2), tmp_path, Layout(beside=("depth",)))
        scenes, captures = RGBDFolder(tmp_path, "*/coded.png", "*/depth.npy"), CodedCaptures(tmp_path)
        assert [scene["name"] for scene in scenes] == ["000000", "000001"]
        assert torch.equal(scenes[1]["image"], captures[1]["coded"])
        assert torch.equal(scenes[1]["depth"], captures[1]["depth"])

    def test_feature_linear_light_beyond_one_is_kept_in_floats(self, tmp_path):
        scene = {"image": torch.full((3, 32, 32), 4.0), "depth": torch.ones(1, 32, 32)}
        optics = small_camera(color_space="linear", sensor=None)
        render_scenes(optics, [scene], tmp_path, Layout(floats=True))
        self.assert_close(CodedCaptures(tmp_path)[0]["coded"], scene["image"])


class TestRefusals(BaseTester):
    def test_exception_a_folder_of_other_captures_names_what_differs(self, whole):
        folder, layout = whole
        before = contents(folder)
        with pytest.raises(ValueError, match=r"holds captures made otherwise \(there / now\): noise_seed \(7 / 8\)$"):
            render_scenes(small_camera(), small_scenes(), folder, layout, seed=8)
        with pytest.raises(ValueError, match=r"sensor.sigma \(0.01 / 0.02\)"):
            render_scenes(small_camera(sensor=SensorNoise(0.02)), small_scenes(), folder, layout, seed=7)
        optics = small_camera()
        with torch.no_grad():
            optics.masks.phase[0, 0, 0] += 1e-3
        with pytest.raises(ValueError, match=r"now\): state_sha256; heights_m$"):
            render_scenes(optics, small_scenes(), folder, layout, seed=7)
        assert contents(folder) == before

    def test_exception_a_folder_of_other_things_is_left_alone(self, tmp_path):
        (tmp_path / "thesis.tex").touch()
        with pytest.raises(ValueError, match="holds files that are no captures: choose another folder"):
            render_scenes(small_camera(), small_scenes(), tmp_path)
        with pytest.raises(ValueError, match=r"thesis.tex: it is not a folder"):
            render_scenes(small_camera(), small_scenes(), tmp_path / "thesis.tex")

    @pytest.mark.parametrize("layout", FORMS, ids=["folders", "shards"])
    def test_exception_a_scene_that_cannot_be_used_is_named_and_those_before_stay(self, layout, tmp_path):
        scenes = [small_scenes()[0], small_scenes()[1], {"image": torch.rand(3, 40, 48)}]
        with pytest.raises(ValueError, match="scene 2 of the data cannot be used: a mapping sample needs an 'image'"):
            render_scenes(small_camera(), scenes, tmp_path, layout)
        there = sorted(path.name for path in tmp_path.iterdir())
        assert there == [*(part.name for part in layout.parts(2)), "render.json"]

    def test_exception_processes_are_counted_from_zero(self, tmp_path):
        with pytest.raises(ValueError, match="rank one of 2 from 0, got 1 and 2"):
            render_scenes(small_camera(), small_scenes(), tmp_path, rank=2, world=2)


class TestCodedCaptures(BaseTester):
    def test_exception_an_unfinished_folder_says_so(self, tmp_path):
        render_scenes(small_camera(), small_scenes(), tmp_path, rank=0, world=2)
        with pytest.raises(FileNotFoundError, match=r"has no index.csv, which rendering writes last: it has not ended"):
            CodedCaptures(tmp_path)

    @pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "key,name,coded\n", "key,name,coded\n1,2\n", "key\0"])
    def test_exception_a_damaged_index(self, text, tmp_path):
        (tmp_path / "index.csv").write_text(text)
        with pytest.raises(ValueError, match=r"cannot read .*index.csv"):
            CodedCaptures(tmp_path)

    def test_exception_a_damaged_capture_is_named(self, whole, tmp_path):
        folder, layout = whole
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        last = tmp_path / layout.parts(5)[-1].name
        damaged = last / "depth.npy" if last.is_dir() else last
        damaged.write_bytes(damaged.read_bytes()[:2000])
        captures = CodedCaptures(tmp_path)
        assert captures[-2]["index"] == 3
        with pytest.raises(ValueError, match=r"capture 000004, .*: cannot read .*"):
            captures[4]
        with pytest.raises(IndexError):
            captures[5]
