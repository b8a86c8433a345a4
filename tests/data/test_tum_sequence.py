"""Sequences whose images and depths are joined by their times."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.data import TUMSequence
from tests.base import BaseTester

IMAGES = ("10.000", "10.033", "10.066", "11.5")
DEPTHS = ("10.002", "10.030", "10.040", "10.090", "12.5")


def write(root, images=IMAGES, depths=DEPTHS):
    for part, times in (("rgb", images), ("depth", depths)):
        (root / part).mkdir(parents=True)
        lines = ["# timestamp filename"]
        for number, time in enumerate(times):
            values = (
                np.full((4, 6, 3), 10, np.uint8) if part == "rgb" else np.full((4, 6), 5000 + 1000 * number, np.uint16)
            )
            if part == "depth":
                values[0, 0] = 0
            assert cv2.imwrite(str(root / part / f"{time}.png"), values)
            lines.append(f"{time} {part}/{time}.png")
        (root / f"{part}.txt").write_text("\n".join(lines) + "\n")


class TestTUMSequence(BaseTester):
    def test_feature_nearest_times_form_pairs_and_each_file_is_used_once(self, tmp_path):
        write(tmp_path)
        data = TUMSequence(tmp_path)
        assert [sample["name"] for sample in data] == ["10.000", "10.033"]
        for sample, metres in zip(data, (1.0, 1.2), strict=True):
            self.assert_close(sample["depth"], torch.full((1, 4, 6), metres))
            assert (~sample["mask"]).nonzero().tolist() == [[0, 0, 0]]
        assert len(TUMSequence(tmp_path, max_difference=0.03)) == 3

    def test_feature_a_depth_between_two_images_belongs_to_the_nearer_one(self, tmp_path):
        write(tmp_path, images=("10.000", "10.009"), depths=("10.005",))
        assert [sample["name"] for sample in TUMSequence(tmp_path)] == ["10.009"]

    @pytest.mark.parametrize("name", ["associations.txt", "associate.txt"])
    @pytest.mark.parametrize("depth_first", [True, False])
    def test_feature_listed_pairs_in_both_orders(self, name, depth_first, tmp_path):
        write(tmp_path)
        pairs = [("10.066 rgb/10.066.png", "10.090 depth/10.090.png"), ("11.5 rgb/11.5.png", "12.5 depth/12.5.png")]
        lines = [" ".join(reversed(pair) if depth_first else pair) for pair in pairs]
        for order in (1, -1):  # sorted by the image's time, whatever the order in the file
            (tmp_path / name).write_text("\n".join(lines[::order]))
            data = TUMSequence(tmp_path)
            assert [sample["name"] for sample in data] == ["10.066", "11.5"]
        self.assert_close(data[1]["depth"].max(), torch.tensor(1.8))

    def test_feature_numbers_of_frames_are_times_too(self, tmp_path):
        """As ICL-NUIM lists them, whose first ten frames would be 1, 10, 2 as text."""
        write(tmp_path, images=("2", "10"), depths=("2", "10"))
        lines = [f"{frame} depth/{frame}.png {frame} rgb/{frame}.png" for frame in ("10", "2")]
        (tmp_path / "associations.txt").write_text("\n".join(lines))
        assert [sample["name"] for sample in TUMSequence(tmp_path)] == ["2", "10"]

    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            ("", r"cannot read .*rgb\.txt: .*"),
            ("# nothing\n", "should list times and files"),
            ("10.0\n", "should list times and files"),
            ("nan rgb/1.png\n", "begin with a time in seconds, got 'nan'"),
            ("rgb/1.png 10.0\n", "begin with a time in seconds, got 'rgb/1.png'"),
            ("10.0 ../secret.png\n", r"files must lie in the folder, got \.\./secret\.png"),
            ("10.0 /etc/passwd\n", "files must lie in the folder, got /etc/passwd"),
            ("99.0 rgb/10.000.png\n", r"has no image and depth within 0\.02 s"),
        ],
    )
    def test_exception_damaged_lists(self, text, sentence, tmp_path):
        write(tmp_path)
        (tmp_path / "rgb.txt").write_text(text)
        with pytest.raises(ValueError, match=sentence):
            TUMSequence(tmp_path)

    def test_exception_nothing_there(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"rgb\.txt: there is no such file"):
            TUMSequence(tmp_path)
