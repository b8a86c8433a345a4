"""Depth files: metres from depth and disparity, holes, and refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.data import read_depth, write_depth
from tests.base import BaseTester

STEREO = {"kind": "disparity", "focal_px": 1000.0, "baseline_m": 0.1}
INF, NAN = float("inf"), float("nan")


def save(path, values, dtype):
    np.save(path, np.array([values], dtype))
    return path


class TestReadDepth(BaseTester):
    def test_feature_millimetres(self, tmp_path):
        depth, valid = read_depth(save(tmp_path / "a.npy", [1, 1500, 65534], np.uint16), 0.001)
        self.assert_close(depth, torch.tensor([[[0.001, 1.5, 65.534]]]), rtol=1e-6, atol=0)
        assert valid.all()
        assert depth.dtype == torch.float32
        assert valid.dtype == torch.bool

    def test_feature_disparity_gives_baseline_times_focal_over_disparity(self, tmp_path):
        """Middlebury: Z = 0.1 * 1000 / (v * 0.25 + 10)."""
        path = save(tmp_path / "a.npy", [40, 160, 360], np.uint16)
        depth, _ = read_depth(path, 0.25, **STEREO, doffs_px=10)
        self.assert_close(depth, torch.tensor([[[5.0, 2.0, 1.0]]]), rtol=1e-6, atol=0)

    @pytest.mark.parametrize(
        ("kind", "stored", "options", "expected"),
        [
            (np.float32, [2, NAN, -1, 0, INF], {}, [2, None, None, None, INF]),
            (np.float32, [2, 9, INF], {"invalid": [9, INF]}, [2, None, None]),
            (np.float32, [50, 0, -5, INF, NAN, -INF], STEREO, [2, INF, None, None, None, None]),
            (np.float32, [50, 0, -5, -10, -11], {**STEREO, "doffs_px": 10}, [100 / 60, 10, 20, INF, None]),
            (np.float32, [50, 0], {**STEREO, "invalid": [0]}, [2, None]),
            (np.uint16, [2, 0, 65535], {"invalid": [65535]}, [2, None, None]),
            (np.int16, [2, 0, -3], {}, [2, None, None]),
            (np.uint8, [50, 0], {**STEREO, "doffs_px": 10}, [100 / 60, None]),
            (np.uint16, [2, 3], {"invalid": [-1, 1e9, NAN, 2.5]}, [2, 3]),
        ],
    )
    def test_convention_holes(self, kind, stored, options, expected, tmp_path):
        """None stands for a hole: what is said to be invalid, and 0 of whole numbers."""
        depth, valid = read_depth(save(tmp_path / "a.npy", stored, kind), **options)
        assert valid.flatten().tolist() == [value is not None for value in expected]
        known = torch.tensor([value for value in expected if value is not None]).float()
        self.assert_close(depth[valid], known, rtol=1e-6, atol=0)
        assert bool((depth > 0).all())

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"kind": "inverse"}, "kind must be one of 'depth', 'disparity', 'distance', got 'inverse'"),
            ({"scale": 0.0}, "scale must be positive and finite, got 0.0"),
            ({"scale": NAN}, "scale must be positive and finite, got nan"),
            ({"kind": "disparity"}, "disparity without calibration cannot give metres"),
            ({"kind": "disparity", "focal_px": 900.0}, "got 900.0 and None"),
            ({**STEREO, "baseline_m": -0.1}, "baseline_m must be positive and finite metres, got -0.1"),
            ({**STEREO, "focal_px": 0}, "focal_px must be positive and finite pixels, got 0"),
            ({**STEREO, "doffs_px": INF}, "doffs_px must be finite pixels, got inf"),
            ({"focal_px": 900.0}, "belong to kind='disparity'"),
            ({"doffs_px": 1.0}, "belong to kind='disparity'"),
            ({"kind": "distance"}, "gives depth by focal_px, the focal length in pixels, got None"),
            ({**STEREO, "kind": "distance"}, "belong to kind='disparity', got kind='distance'"),
            ({"kind": "distance", "focal_px": -1.0}, "focal_px must be positive and finite pixels, got -1.0"),
            ({"rotated_bits": 16}, "rotated_bits must be one of 0, 1, .*, got 16"),
        ],
    )
    def test_exception_names_the_bad_option(self, options, message, tmp_path):
        """Before the file is looked at: there is none."""
        with pytest.raises(ValueError, match=message):
            read_depth(tmp_path / "none.png", **options)

    @pytest.mark.parametrize(
        ("stored", "message"),
        [
            (np.zeros((3, 4), np.uint16), "no valid depth at any pixel"),
            (np.full((3, 4), NAN), "no valid depth at any pixel"),
            (np.ones((3, 4, 3), np.uint8), "depth has one channel, this has 3"),
            (np.ones((3, 4, 2), np.uint8), "depth has one channel, this has 2"),
        ],
    )
    def test_exception_file_holds_no_depth(self, stored, message, tmp_path):
        np.save(tmp_path / "a.npy", stored)
        with pytest.raises(ValueError, match=f"a.npy: .*{message}"):
            read_depth(tmp_path / "a.npy")

    def test_exception_missing_empty_folder_or_text(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"none\.png"):
            read_depth(tmp_path / "none.png")
        with pytest.raises(ValueError, match="it is a folder"):
            read_depth(tmp_path)
        for name, content in (("empty.png", b""), ("text.png", b"a letter"), ("text.pfm", b"Pf this is prose")):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(ValueError, match=name):
                read_depth(tmp_path / name)


class TestWriteDepth(BaseTester):
    def test_feature_pfm_keeps_every_bit_and_infinity(self, tmp_path):
        depth = torch.rand(1, 6, 9) + 0.1
        depth[0, 0, 0] = INF
        write_depth(tmp_path / "a.pfm", depth.requires_grad_())
        assert torch.equal(read_depth(tmp_path / "a.pfm").depth, depth)

    @pytest.mark.parametrize("scale", [0.001, 0.0002])
    def test_feature_png_keeps_multiples_of_the_scale(self, scale, dtype, tmp_path):
        depth = torch.randint(1, 65536, (1, 6, 9)) * scale
        write_depth(tmp_path / "a.png", depth.to(dtype), scale)
        self.assert_close(read_depth(tmp_path / "a.png", scale).depth, depth.float(), rtol=1e-6, atol=0)
        assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint16

    def test_feature_scale_of_a_pfm_is_undone_by_reading(self, tmp_path):
        write_depth(tmp_path / "a.pfm", torch.full((1, 2, 2), 1.5), scale=0.25)
        assert cv2.imread(str(tmp_path / "a.pfm"), cv2.IMREAD_UNCHANGED)[0, 0] == 6
        assert read_depth(tmp_path / "a.pfm", scale=0.25).depth[0, 0, 0] == 1.5

    @pytest.mark.parametrize(
        ("name", "depth", "error", "message"),
        [
            ("a.tif", torch.ones(1, 2, 2), ValueError, "suffix of a depth file must be one of '.pfm', '.png'"),
            ("a.png", torch.full((1, 2, 2), 70.0), ValueError, "holds 0.001 to 65.535 m, got 70"),
            ("a.png", torch.full((1, 2, 2), 0.0004), ValueError, "holds 0.001 to 65.535 m, got 0.0004"),
            ("a.png", torch.full((1, 2, 2), INF), ValueError, "holds 0.001 to 65.535 m, got inf"),
            ("a.pfm", torch.zeros(1, 2, 2), ValueError, "depth must be positive metres, got 0.0"),
            ("a.pfm", torch.full((1, 2, 2), NAN), ValueError, "depth must be positive metres, got nan"),
            ("a.pfm", torch.ones(3, 2, 2), ValueError, r"\(3, 2, 2\)"),
            ("a.pfm", torch.ones(2, 2), ValueError, r"\(2, 2\)"),
            ("a.pfm", torch.ones(1, 2, 2).int(), TypeError, "int32"),
            ("none/a.pfm", torch.ones(1, 2, 2), FileNotFoundError, "there is no folder"),
        ],
    )
    def test_exception_names_the_bad_value(self, name, depth, error, message, tmp_path):
        with pytest.raises(error, match=message):
            write_depth(tmp_path / name, depth, scale=0.001)
        assert list(tmp_path.iterdir()) == []

    def test_exception_a_scale_of_units_per_metre_is_refused_for_saturated_files_too(self, tmp_path):
        with pytest.raises(ValueError, match=r"for 1000 units in a metre give 0\.001, not 1000"):
            write_depth(tmp_path / "a.png", torch.full((1, 2, 2), 1.5), 1000, saturate=True)
        assert not (tmp_path / "a.png").exists()
