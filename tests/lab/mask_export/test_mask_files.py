from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kornia_tidy import DwellTimes, LearnableDwellTimes, PixelwiseMask, SpatialLightModulator, Switching, TiDyOptics
from kornia_tidy.lab.mask_export.mask_files import masks_in_state, read_heights, write_heights
from kornia_tidy.masks import ZernikeMask
from kornia_tidy.modulator import GreyLevels
from kornia_tidy.optics import NOA61, PMMA
from tests.base import BaseTester


class TestMaskFiles(BaseTester):
    @pytest.mark.parametrize("material", [None, NOA61])
    def test_feature_a_cameras_state(self, tmp_path, material):
        optics = TiDyOptics(PixelwiseMask(3, material=material))
        save_file(optics.state_dict(), tmp_path / "camera.safetensors")
        save_file(optics.masks.state_dict(), tmp_path / "masks.safetensors")
        for name in ("camera", "masks"):
            heights = read_heights(tmp_path / f"{name}.safetensors", material)
            self.assert_close(heights, optics.masks.heights().detach(), rtol=1e-6, atol=0)

    def test_feature_a_camera_loads_what_was_written(self, tmp_path):
        from safetensors.torch import load_file

        heights = 1e-6 * torch.rand(5, 23, 23, dtype=torch.float64)
        write_heights(tmp_path / "m.safetensors", heights)
        optics = TiDyOptics()
        optics.load_state_dict(load_file(tmp_path / "m.safetensors"))
        self.assert_close(optics.masks.phase.detach().double(), heights * math.pi / 530e-9, rtol=1e-6, atol=0)

    def test_feature_npy_is_metres(self, tmp_path):
        heights = 1e-6 * torch.rand(2, 3, 4, dtype=torch.float64)
        write_heights(tmp_path / "m.npy", heights)
        assert np.array_equal(np.load(tmp_path / "m.npy"), heights.numpy())
        assert torch.equal(read_heights(tmp_path / "m.npy"), heights)
        np.save(tmp_path / "one.npy", np.full((3, 3), 1e-6, np.float32))
        assert read_heights(tmp_path / "one.npy").shape == (1, 3, 3)

    def test_feature_dwell_times_come_with_the_state(self):
        for modulator in (
            DwellTimes((3, 1)),
            Switching(1e-3, dwell=DwellTimes((3, 1))),
            LearnableDwellTimes((3, 1)),
            SpatialLightModulator(GreyLevels(8), LearnableDwellTimes((3, 1))),
        ):
            state = TiDyOptics(PixelwiseMask(2), modulator=modulator, fidelity="draft").state_dict()
            assert masks_in_state(state).dwell == pytest.approx([0.75, 0.25])
            state.pop("_extra_state")  # as in earlier versions
            learnt = "LearnableDwellTimes" in repr(modulator)
            assert masks_in_state(state).dwell == (pytest.approx([0.75, 0.25]) if learnt else None)
        assert masks_in_state(TiDyOptics(fidelity="draft").state_dict()).dwell is None

    def test_exception_another_material_than_the_saved_one(self, tmp_path):
        save_file(TiDyOptics(PixelwiseMask(1, material=NOA61)).state_dict(), tmp_path / "camera.safetensors")
        with pytest.raises(ValueError, match="its masks are of NOA61: leave the material out, got PMMA"):
            read_heights(tmp_path / "camera.safetensors", PMMA)

    def test_exception(self, tmp_path):
        save_file(ZernikeMask(2).state_dict(), tmp_path / "z.safetensors")
        (tmp_path / "bad.safetensors").write_bytes(b"no tensors")
        (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY")
        (tmp_path / "lfs.npy").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
        np.save(tmp_path / "int.npy", np.ones((2, 2), int))
        np.save(tmp_path / "half.npy", np.ones((2, 2), np.float16))
        save_file({"phase": torch.ones(1, 2, 2).int()}, tmp_path / "int.safetensors")
        np.save(tmp_path / "nan.npy", np.full((2, 2), np.nan))
        np.save(tmp_path / "object.npy", np.array([{}]), allow_pickle=True)
        for name, sentence in {
            "none.npy": "there is no such file",
            "x.pt": "the suffix of a file of masks must be one of '.npy', '.safetensors', got '.pt'",
            "z.safetensors": "it has no 'masks.phase', only coefficients",
            "bad.safetensors": "cannot read .*bad.safetensors",
            "bad.npy": "cannot read .*bad.npy",
            "lfs.npy": "cannot read .*lfs.npy: it is a pointer of Git LFS",
            "int.npy": r"heights are floats in 2 or 3 axes, not int64 \(2, 2\)",
            "half.npy": "cannot read .*half.npy: heights are floats of 32 or 64 bits",
            "int.safetensors": "cannot read .*: phase must be floating point, got torch.int32",
            "nan.npy": "cannot read .*nan.npy: heights must be finite metres",
            "object.npy": "cannot read .*object.npy",
        }.items():
            with pytest.raises((ValueError, FileNotFoundError), match=sentence):
                read_heights(tmp_path / name)
        with pytest.raises(ValueError, match="suffix of a file of masks"):
            write_heights(tmp_path / "m.csv", torch.zeros(1, 2, 2))
