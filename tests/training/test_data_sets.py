"""Data sets by name: small ones in the published formats, and real samples, trained on and evaluated end to end."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import dead_leaves, photographic_leaves
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.data_sets import PAINTED, SCENES, _photographs, make_scenes
from kornia_tidy.training.scenes import SceneLoader
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester
from tests.data.published import write_flying_things, write_nyu

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*multi-threaded, use of fork:DeprecationWarning",
    "ignore:.*LeafSpec:FutureWarning",
    "ignore:.*beyond the camera's range:UserWarning",
)
PARTS = {f"{half}/{part}": 1 for half in ("TRAIN", "TEST") for part in "ABC"}
PAIRS, SIDES = 12, (40, 50)
MILLIMETRES = {"image": "*.png", "depth": "*_depth.png", "scale": 0.001}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """A folder of each kind of data."""
    things, nyu, pairs, photographs = (
        tmp_path_factory.mktemp(name) for name in ("things", "nyu", "pairs", "photographs")
    )
    write_flying_things(things, {**PARTS, "TRAIN/A": 8}, size=(279, 280))
    write_nyu(nyu, 8)
    row, column = np.indices(SIDES)
    for number in range(PAIRS):
        picture = np.stack([row, column, np.full(SIDES, number)], -1)[..., ::-1].astype(np.uint8)  # RGB, stored BGR
        assert cv2.imwrite(str(pairs / f"{number:02d}.png"), picture)
        assert cv2.imwrite(str(pairs / f"{number:02d}_depth.png"), (400 + 50 * row + column).astype(np.uint16))
        assert cv2.imwrite(str(photographs / f"{number:02d}.png"), np.full((40, 50, 3), 10 * (1 + number), np.uint8))
    (pairs / "rgbd.json").write_text(json.dumps(MILLIMETRES))
    files = {"flying-things": things, "flying-things-patches": things, "nyu": nyu, "rgbd-folder": pairs}
    return {"photo-collages": photographs, **files}


FILES = [name for name in SCENES if name not in PAINTED]
# Scenes in the splits for training, validation and testing, and the pixels of a scene.
EXPECTED = {
    "flying-things": ((18, 2, 6), "279 x 280"),  # of 2 frames a sequence; the tenth of TRAIN is held out
    "flying-things-patches": ((6, 2, 419), "278 x 278"),
    "nyu": ((3, 1, 4), "427 x 561"),
    "rgbd-folder": ((10, 1, 1), "40 x 50"),
}


def settings_of(name, roots, **changes):
    settings = TrainingSettings(data=name, root=str(roots[name]), size=32, scenes=6, validation_scenes=2, seed=1)
    return settings.replace(**changes)


def names_of(scenes):
    return {scenes[i]["name"].partition("@")[0] for i in range(len(scenes))}


class TestMakeScenes(BaseTester):
    @pytest.mark.parametrize("name", SCENES)
    def test_smoke_every_split_gives_scenes_of_the_size_in_metres(self, name, roots):
        settings = settings_of(name, {**dict.fromkeys(PAINTED, "."), **roots})
        for split in ("train", "validation", "test"):
            sample = make_scenes(settings, split, 2)[0]
            assert sample["image"].shape == (3, 32, 32)
            assert sample["depth"].shape == sample["mask"].shape == (1, 32, 32)
            assert 0 <= sample["image"].min() <= sample["image"].max() <= 1
            assert sample["depth"].min() >= 0.29
            assert sample["mask"].dtype == torch.bool

    @pytest.mark.parametrize("name", FILES)
    def test_cardinality(self, name, roots):
        settings = settings_of(name, roots)
        lengths = tuple(len(make_scenes(settings, split)) for split in ("train", "validation", "test"))
        assert lengths == EXPECTED[name][0]
        assert len(make_scenes(settings.replace(validation_scenes=1), "validation")) == 1
        assert len(make_scenes(settings, "test", 1)) == 1

    @pytest.mark.parametrize("name", FILES)
    def test_feature_no_scene_is_in_two_splits(self, name, roots):
        settings = settings_of(name, roots, scenes=30)
        train, validation, test = (
            names_of(make_scenes(settings, split, 9)) for split in ("train", "validation", "test")
        )
        assert not train & validation
        assert not (train | validation) & test
        if name.startswith("flying"):
            assert all(one.startswith("TEST/") for one in test)
            assert all(one.startswith("TRAIN/") for one in train | validation)

    def test_feature_no_photograph_is_in_two_splits(self, roots):
        settings = settings_of("photo-collages", roots)
        paths = [set(_photographs(settings, split)) for split in ("train", "validation", "test")]
        assert [len(part) for part in paths] == [10, 1, 1]
        assert len(set.union(*paths)) == 12
        assert paths != [set(_photographs(settings.replace(seed=2), part)) for part in ("train", "validation", "test")]

    def test_feature_a_folder_is_split_by_the_seed(self, roots):
        settings = settings_of("rgbd-folder", roots)
        parts = [names_of(make_scenes(settings, split)) for split in ("train", "validation", "test")]
        assert set.union(*parts) == names_of(make_scenes(settings, "all")) == {f"{i:02d}" for i in range(PAIRS)}
        assert parts == [names_of(make_scenes(settings, split)) for split in ("train", "validation", "test")]
        tests = {min(names_of(make_scenes(settings.replace(seed=seed), "test"))) for seed in range(6)}
        assert len(tests) > 2

    def test_feature_training_crops_follow_from_epoch_and_scene_whoever_loads_them(self, roots):
        """The picture's red and green say which row and column they were, and depth and mask come along."""
        scenes = make_scenes(settings_of("rgbd-folder", roots), "train")
        places = []
        for epoch, workers in ((0, 0), (0, 1), (1, 0)):
            loader = SceneLoader(scenes, 2, seed=3, workers=workers)
            loader._batches.set_epoch(epoch)
            batches = list(loader)
            image = torch.cat([batch["image"] for batch in batches]).mul(255).round()
            depth = torch.cat([batch["depth"] for batch in batches])
            self.assert_close(depth, (400 + 50 * image[:, :1] + image[:, 1:2]) / 1000)
            order = image[:, 2, 0, 0].argsort()
            places.append(image[order, :2, 0, 0].tolist())
        assert places[0] == places[1] != places[2]
        assert len({tuple(place) for place in places[0] + places[2]}) > 5

    @pytest.mark.parametrize("split", ["validation", "test", "all"])
    def test_feature_others_are_cut_in_the_middle(self, split, roots):
        image = make_scenes(settings_of("rgbd-folder", roots), split)[0]["image"].mul(255).round()
        assert image[:2, 0, 0].tolist() == [(SIDES[0] - 32) // 2, (SIDES[1] - 32) // 2]

    @pytest.mark.parametrize("name", ["flying-things", "flying-things-patches"])
    @pytest.mark.parametrize("depth_range", [None, (7.0, float("inf"))])
    def test_convention_the_nearest_things_are_at_the_cameras_near_end(self, name, depth_range, roots):
        """Nearness is disparity over 160 px; the files' red channel is 8 times their disparity."""
        settings = settings_of(name, roots, depth_range=depth_range)
        sample = make_scenes(settings, "test", 1)[0]
        disparity = sample["image"][:1] * 255 / 8
        self.assert_close(
            normalised_inverse_depth(settings.camera(), sample["depth"]), disparity / 160, rtol=1e-5, atol=1e-6
        )

    def test_convention_the_seeds_of_dead_leaves_are_fixed(self):
        """Runs that were begun must see the same scenes when they go on."""
        assert keyed_seed(0, "train") == 1382848523564605726
        for split in ("train", "validation", "test"):
            settings = TrainingSettings(data="dead-leaves", size=24, scenes=3, validation_scenes=2)
            seed = keyed_seed(keyed_seed(0, split), "scene", 1)
            image, depth = dead_leaves(24, 24, depth_range=(0.3, float("inf")), num_leaves=2, seed=seed)
            sample = make_scenes(settings, split)[1]
            assert torch.equal(sample["image"], image)
            assert torch.equal(sample["depth"], depth)
            seed = keyed_seed(keyed_seed(0, split), "photographic scene", 1)
            image, depth = photographic_leaves(24, 24, depth_range=(0.3, float("inf")), seed=seed)
            sample = make_scenes(settings.replace(data="photographic-leaves"), split)[1]
            assert torch.equal(sample["image"], image)
            assert torch.equal(sample["depth"], depth)

    @pytest.mark.parametrize("name", FILES)
    def test_exception_scenes_smaller_than_the_size(self, name, roots):
        sides = EXPECTED[name][1]
        for split in ("train", "test"):
            with pytest.raises(ValueError, match=f" has {sides} pixels: choose a size of .* or less, not 600$"):
                make_scenes(settings_of(name, roots, size=600), split)

    @pytest.mark.parametrize(
        ("name", "sentence"),
        [
            ("flying-things", "FlyingThings3D is not in data/flying-things: download"),
            ("flying-things-patches", "FlyingThings3D is not in data/flying-things-patches: download"),
            ("nyu", "NYU Depth v2 is not in data/nyu: download"),
            ("photo-collages", "there is no folder data/photo-collages: it must hold photographs (.png, .tif,"),
            ("rgbd-folder", "there is no data/rgbd-folder/rgbd.json: it tells which files"),
        ],
    )
    def test_exception_missing_data_say_what_goes_where(self, name, sentence, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        assert main(["train", "--data", name, "-o", "run"]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1
        assert not (tmp_path / "run").exists()

    def test_exception_too_few_pairs(self, tmp_path):
        for number in range(2):
            cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((40, 40), np.uint8))
            cv2.imwrite(str(tmp_path / f"{number}_depth.png"), np.ones((40, 40), np.uint16))
        (tmp_path / "rgbd.json").write_text(json.dumps(MILLIMETRES))
        settings = settings_of("rgbd-folder", {"rgbd-folder": tmp_path})
        with pytest.raises(ValueError, match="has 2 scenes: 3 or more are needed"):
            make_scenes(settings, "train")
        assert len(make_scenes(settings, "all")) == 2

    def test_exception_names_the_bad_value(self, roots):
        with pytest.raises(ValueError, match=r"data must be one of 'photographic-leaves', .*, got 'kitti'"):
            make_scenes(TrainingSettings(data="kitti"), "train")
        with pytest.raises(ValueError, match="split must be one of 'train', 'validation', 'test', got 'all'"):
            make_scenes(settings_of("nyu", roots), "all")
        with pytest.raises(ValueError, match="the number of scenes must be 1 or more, got 0"):
            make_scenes(settings_of("nyu", roots), "test", 0)


def train_and_evaluate(name, root, tmp_path, capsys, *options):
    """Two steps, then a table of one scene; returns its line and the summary."""
    run = tmp_path / "run"
    small = ["--head", "plain", "--width", "4", "--size", "40", "--scenes", "2", "--validation-scenes", "1"]
    learn = ["--task", "joint", "--masks", "1", "--batch", "1", "--epochs", "1", "--fidelity", "draft"]
    assert main(["train", "--data", name, "--root", str(root), *small, *learn, *options, "-o", str(run)]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(run / "last.safetensors"), "--scenes", "1", "--pictures", "0"]) == 0
    table = capsys.readouterr().out
    with (run / "evaluation" / "results.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    for score in row.keys() - {"scene", "name"}:
        assert f"\n{score}" in table
        assert np.isfinite(float(row[score])), score
    return row, json.loads((run / "evaluation" / "summary.json").read_text())


class TestEndToEnd(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("name", FILES)
    def test_feature_two_steps_and_a_table_from_each_data_set(self, name, roots, tmp_path, capsys):
        pytest.importorskip("lightning.pytorch")
        row, summary = train_and_evaluate(name, roots[name], tmp_path, capsys)
        tested = make_scenes(settings_of(name, roots, seed=0), "test")
        assert row["name"].partition("@")[0] in names_of(tested)
        assert summary["step"] >= 2
        assert summary["split"] == "test"

    def test_feature_a_folder_that_was_not_trained_on_is_evaluated_whole(self, roots, tmp_path):
        pytest.importorskip("lightning.pytorch")
        small = ["--head", "plain", "--width", "4", "--size", "40", "--scenes", "2", "--validation-scenes", "1"]
        learn = ["--batch", "2", "--masks", "1", "--epochs", "1", "--fidelity", "draft"]
        assert main(["train", *small, *learn, "-o", str(tmp_path)]) == 0
        command = ["evaluate", str(tmp_path / "last.safetensors"), "--pictures", "0", "-o", str(tmp_path / "e")]
        assert main([*command, "--data", "rgbd-folder", "--root", str(roots["rgbd-folder"])]) == 0
        summary = json.loads((tmp_path / "e" / "summary.json").read_text())
        assert (summary["scenes"], summary["split"]) == (PAIRS, "all")
