"""Folders of pictures with depth: what belongs together, by name, and what is left over."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.data import RGBDFolder, UnreadableItemError, described_folder
from tests.base import BaseTester
from tests.data.published import write_pfm


def write(root, image, depth, millimetres, size=(4, 6)):
    """A grey-blue picture and a depth map, each of one value."""
    for name, values in ((image, np.full((*size, 3), (255, 51, 51), np.uint8)), (depth, np.full(size, millimetres))):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(root / name), values.astype(np.uint16) if name == depth else values)


class TestRGBDFolder(BaseTester):
    @pytest.mark.parametrize(
        ("image", "depth", "name"),
        [
            ("{}.color.png", "{}.depth.png", "{}"),
            ("rgb/{}.png", "depth/{}.png", "{}"),
            ("{}.png", "{}_depth.png", "{}"),
            ("{}_rgb.png", "{}.png", "{}"),
            ("{}/rgb.png", "{}/depth.png", "{}"),
            ("a [1]/({}).png", "a [1]/({})?.png", "{}"),
        ],
    )
    def test_feature_pairs_are_found_by_their_names(self, tmp_path, image, depth, name):
        for number in (3, 1, 2):
            write(tmp_path, image.format(f"s{number}"), depth.format(f"s{number}"), 1000 * number)
        (tmp_path / "notes.txt").touch()
        data = RGBDFolder(tmp_path, image.format("*"), depth.format("*"), scale=0.001)
        assert [data.name(index) for index in range(len(data))] == [name.format(f"s{n}") for n in (1, 2, 3)]
        for index, sample in enumerate(data):
            self.assert_close(sample["image"][:, 0, 0], torch.tensor([0.2, 0.2, 1.0]))
            assert torch.equal(sample["depth"], torch.full((1, 4, 6), index + 1.0))

    def test_feature_names_in_two_forms_of_unicode_are_a_pair(self, tmp_path):
        write(tmp_path, "\u00e9.png", "e\u0301_depth.png", 1000)
        assert RGBDFolder(tmp_path, "./*.png", "./*_depth.png", scale=0.001).names == ["\u00e9"]

    def test_feature_names_are_sorted_as_text(self, tmp_path):
        for number in (2, 10, 1):
            write(tmp_path, f"s{number}.png", f"s{number}_depth.png", 1000)
        data = RGBDFolder(tmp_path, "*.png", "*_depth.png", scale=0.001)
        assert [data.name(index) for index in range(len(data))] == ["s1", "s10", "s2"]

    def test_feature_several_stars_must_all_agree(self, tmp_path):
        for scene, frame, millimetres in (("b", "0", 1), ("a", "1", 2), ("a", "0", 3)):
            write(tmp_path, f"{scene}/color/{frame}.png", f"{scene}/depth/{frame}.png", millimetres)
        data = RGBDFolder(tmp_path, "*/color/*.png", "*/depth/*.png")
        assert [(s["name"], s["depth"].mean().item()) for s in data] == [("a/0", 3), ("a/1", 2), ("b/0", 1)]

    def test_feature_depth_options_are_passed_on(self, tmp_path):
        write(tmp_path, "x.png", "unused/x.png", 1)
        write_pfm(tmp_path / "x.pfm", np.array([[5, 10, 7, np.inf, 20, 0]] * 4, np.float32))
        options = {"kind": "disparity", "focal_px": 100.0, "baseline_m": 0.1, "invalid": [7]}
        sample = RGBDFolder(tmp_path, "*.png", "*.pfm", **options)[0]
        assert sample["mask"][0, 0].tolist() == [True, True, False, False, True, True]
        self.assert_close(sample["depth"][0, 0], torch.tensor([2.0, 1.0, 1.0, 0.5, 0.5, torch.inf]))

    @pytest.mark.parametrize(("pattern", "path"), [("*/*.json", "{}/{}.json"), ("*/all.json", "{}/all.json")])
    def test_feature_each_pair_has_its_calibration(self, pattern, path, tmp_path):
        for scene, frame in (("a", "0"), ("a", "1"), ("b", "0")):
            write(tmp_path, f"{scene}/{frame}.png", f"{scene}/{frame}_depth.png", 2)
            scale = {"a": 0.5, "b": 2.0}[scene] if pattern == "*/all.json" else {"0": 0.5, "1": 2.0}[frame]
            (tmp_path / path.format(scene, frame)).write_text(f'{{"scale": {scale}}}')
        data = RGBDFolder(tmp_path, "*/*.png", "*/*_depth.png", calibration=pattern, scale=7)
        found = [sample["depth"].unique().item() for sample in data]
        assert found == ([1, 1, 4] if pattern == "*/all.json" else [1, 4, 1])

    def test_exception_calibrations(self, tmp_path):
        write(tmp_path, "x.png", "x_depth.png", 1)
        patterns = ("*.png", "*_depth.png")
        for pattern, error, sentence in (
            ("*.json", FileNotFoundError, r"x\.json, the calibration of x$"),
            ("*/*.json", ValueError, r"at most 1 \* as the images have, got '\*/\*\.json'"),
            ("../*.json", ValueError, "must stay within the folder"),
        ):
            with pytest.raises(error, match=sentence):
                RGBDFolder(tmp_path, *patterns, calibration=pattern)
        (tmp_path / "x.json").write_text('{"focal_px": 5}')
        with pytest.raises(UnreadableItemError, match="focal_px, baseline_m and doffs_px belong to"):
            RGBDFolder(tmp_path, *patterns, calibration="*.json")[0]
        with pytest.raises(ValueError, match="resample must be one of"):
            RGBDFolder(tmp_path, *patterns, resample="area")

    def test_exception_files_without_a_partner_are_named(self, tmp_path):
        for name in ("a", "b", "c", "d", "e"):
            write(tmp_path, f"rgb/{name}.png", f"depth/{name}.png", 1)
        (tmp_path / "depth/b.png").unlink()
        (tmp_path / "rgb/d.png").unlink()
        with pytest.raises(ValueError, match=r"2 files in .* have no partner by 'rgb/\*\.png' .*: depth/d.png"):
            RGBDFolder(tmp_path, "rgb/*.png", "depth/*.png")
        for name in ("a", "e"):
            (tmp_path / f"depth/{name}.png").unlink()
        with pytest.raises(ValueError, match=r"4 files .*: depth/d.png, rgb/a.png, rgb/b.png, \.\.\.$"):
            RGBDFolder(tmp_path, "rgb/*.png", "depth/*.png")

    def test_exception_nothing_there(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"there is no folder .*nowhere"):
            RGBDFolder(tmp_path / "nowhere", "*.png", "*.pfm")
        with pytest.raises(FileNotFoundError, match=r"no image in .* fits '\*\.png'"):
            RGBDFolder(tmp_path, "*.png", "*.pfm")
        write(tmp_path, "x.png", "y.tiff", 1)
        with pytest.raises(FileNotFoundError, match=r"no depth file in .* fits '\*\.pfm'"):
            RGBDFolder(tmp_path, "*.png", "*.pfm")

    @pytest.mark.parametrize("pattern", ["/etc/*", "../*.png", "a/../../*.png", "..", "*/\0"])
    def test_exception_patterns_that_lead_out_of_the_folder(self, tmp_path, pattern):
        write(tmp_path, "in/x.png", "in/x.pfm", 1)
        (tmp_path / "secret.png").write_bytes((tmp_path / "in/x.png").read_bytes())
        for image, depth in ((pattern, "*.pfm"), ("*.png", pattern)):
            with pytest.raises(ValueError, match=r"(must stay within the folder|equally many)"):
                RGBDFolder(tmp_path / "in", image, depth)

    @pytest.mark.parametrize(("image", "depth"), [("*.png", "x.pfm"), ("x.png", "x.pfm"), ("*/*.png", "*.pfm")])
    def test_exception_patterns_without_equally_many_stars(self, tmp_path, image, depth):
        with pytest.raises(ValueError, match=r"must have a \* and equally many"):
            RGBDFolder(tmp_path, image, depth)

    def test_exception_options_are_checked_before_any_file(self, tmp_path):
        with pytest.raises(ValueError, match="focal_px and baseline_m are needed"):
            RGBDFolder(tmp_path, "*.png", "*.pfm", kind="disparity", invalid=[0])
        with pytest.raises(TypeError, match="focal"):
            RGBDFolder(tmp_path, "*.png", "*.pfm", focal=3.0)

    def test_exception_sizes_that_differ_are_an_unreadable_item(self, tmp_path):
        write(tmp_path, "x.png", "x_depth.png", 1)
        write(tmp_path, "unused.png", "x_depth.png", 1, size=(6, 4))
        (tmp_path / "unused.png").unlink()
        with pytest.raises(UnreadableItemError, match=r"item 0 of RGBDFolder, x: .* must have the same size"):
            RGBDFolder(tmp_path, "*.png", "*_depth.png")[0]


class TestDescribedFolder(BaseTester):
    def test_feature_the_folder_tells_how_depth_is_stored(self, tmp_path):
        write(tmp_path, "a/1.png", "b/1.png", 2500)
        (tmp_path / "rgbd.json").write_text('{"image": "a/*.png", "depth": "b/*.png", "scale": 0.001, "invalid": [9]}')
        (sample,) = described_folder(tmp_path)
        self.assert_close(sample["depth"].unique(), torch.tensor([2.5]))

    def test_feature_size_calibration_and_fill_are_described_too(self, tmp_path):
        write(tmp_path, "1.png", "1_d.png", 2)
        write(tmp_path, "unused/1.png", "1_d.png", 2, size=(2, 3))
        (tmp_path / "1.json").write_text('{"scale": 0.5}')
        about = '"calibration": "*.json", "resample": "depth", "fill": "guided", "rotated_bits": 0'
        (tmp_path / "rgbd.json").write_text('{"image": "*.png", "depth": "*_d.png", ' + about + "}")
        (sample,) = described_folder(tmp_path)
        assert torch.equal(sample["depth"], torch.ones(1, 4, 6))

    def test_exception_without_a_description(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"there is no .*rgbd\.json: it tells which files"):
            described_folder(tmp_path)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("{", "cannot read .*rgbd.json: Expecting"),
            ("[1]", 'it should hold "image" and "depth" and may hold scale, kind'),
            ('{"image": "*.png"}', 'it should hold "image" and "depth"'),
            ('{"image": "*.png", "depth": "*_d.png", "unit": 1}', "it should hold .* got .*'unit': 1"),
            ('{"image": "*.png", "depth": "*.png"}', "must have different patterns, got '[*].png' for both"),
            ('{"image": "*.png", "depth": "*_d.png", "scale": "mm"}', "cannot read .*rgbd.json: "),
            ('{"image": 1, "depth": 2}', "cannot read .*rgbd.json: image must be a text, got 1"),
            ('{"image": "/etc/*", "depth": "*_d.png"}', "must stay within the folder, got '/etc/"),
            ('{"image": "*.png", "depth": "*_d.png", "invalid": 5}', "invalid must be a list of numbers, got 5"),
            ('{"image": "*.png", "depth": "*_d.png", "invalid": [null]}', "invalid must be a list of numbers"),
            ('{"image": "*.png", "depth": "*_d.png", "scale": true}', "scale must be a number, got True"),
            ('{"image": "*.png", "depth": "*_d.png", "scale": 1' + "0" * 400 + "}", "at most 300 digits, got 401"),
            ("[" * 100_000, "cannot read .*rgbd.json: its JSON is nested deeper than 100 levels"),
            ('{"image": "*.png", "depth": "*_d.png", "scale": -1}', "scale must be positive"),
        ],
    )
    def test_exception_a_description_that_does_not_tell_it(self, text, message, tmp_path):
        (tmp_path / "rgbd.json").write_text(text)
        with pytest.raises(ValueError, match=message):
            described_folder(tmp_path)
