from __future__ import annotations

import os
from itertools import pairwise

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kornia_tidy import Fidelity, NoMask, PixelwiseMask, TiDyOptics
from kornia_tidy.cli import main
from kornia_tidy.data import read_image
from tests.base import BaseTester
from tests.optics.lens.written_files import doublet, zemax


def rows(text: str) -> list[list[str]]:
    """The lines of numbers, split: depth, unit, psi, colour, its unit, held, %, peak, %, Strehl, MTF50."""
    return [line.split() for line in text.splitlines() if " nm  " in line and "%" in line]


class TestPsf(BaseTester):
    def test_feature_a_plain_lens_is_sharpest_in_focus(self, tmp_path, capsys):
        np.save(tmp_path / "flat.npy", np.zeros((23, 23)))
        path = tmp_path / "out.png"
        words = ["psf", str(tmp_path / "flat.npy"), "-o", str(path), "--depths", "0.4,0.595,inf"]
        assert main(words) == 0
        out = capsys.readouterr().out
        table = rows(out)
        assert [row[0] for row in table[::3]] == ["0.4", "0.595", "inf"]
        strehl = [float(row[-2]) for row in table if "530" in row]
        assert strehl[1] == pytest.approx(1, abs=2e-3)
        assert max(strehl[0], strehl[2]) < 0.2
        half = [float(row[-1]) for row in table if "530" in row]
        assert half[1] > 2 * max(half[0], half[2])
        assert read_image(path).shape[2] > 1000

    def test_feature_numbers_are_those_of_the_bank(self, tmp_path, capsys):
        words = ["psf", "phasecam3d", "-o", str(tmp_path / "a.png"), "--depths", "0.85", "--window", "31"]
        assert main(words) == 0
        fidelity = Fidelity(window=31, stray_light="discard")
        optics = TiDyOptics.from_preset("phasecam3d", generator=torch.Generator().manual_seed(0), fidelity=fidelity)
        psfs = optics.psf_bank(defocus=[0.0]).psfs.detach()[0]
        for row, own in zip(rows(capsys.readouterr().out), psfs, strict=True):
            percent = [float(word) for word, unit in pairwise(row) if unit == "%"]
            assert percent[0] == pytest.approx(100 * float(own.sum()), abs=0.06)
            assert percent[1] == pytest.approx(100 * float(own.max()), abs=0.006)

    @pytest.mark.parametrize("suffix", [".npy", ".safetensors"])
    def test_feature_masks_of_a_file_are_those_drawn(self, suffix, tmp_path, capsys):
        masks, name = PixelwiseMask(1, generator=torch.Generator().manual_seed(1)), os.fsdecode(b"a$\\b$\xff")
        if suffix == ".npy":
            np.save(tmp_path / f"{name}.npy", masks.heights().detach().numpy())
        else:
            save_file(masks.state_dict(), tmp_path / f"{name}.safetensors")
        output = ["-o", str(tmp_path / "a.png"), "--depths", "1", "--window", "21"]
        assert main(["psf", str(tmp_path / f"{name}{suffix}"), *output]) == 0
        optics = TiDyOptics(masks, fidelity=Fidelity(window=21, stray_light="discard"))
        psi = optics.camera.defocus(torch.tensor([1.0])).tolist()
        held = 100 * optics.psf_bank(defocus=psi).psfs.detach().sum((2, 3))[0]
        told = [float(row[row.index("%") - 1]) for row in rows(capsys.readouterr().out)]
        self.assert_close(torch.tensor(told), held.float(), rtol=0, atol=0.06)

    @pytest.mark.takes_seconds
    def test_feature_over_the_field_of_a_lens_numbers_are_those_of_the_bank(self, tmp_path, capsys):
        path = tmp_path / "lens.png"
        words = ["--lens", "single-50mm", "--field", "2", "--depths", "0.595", "--fidelity", "draft", "--window", "31"]
        assert main(["psf", *words, "-o", str(path)]) == 0
        fidelity = Fidelity.preset("draft").replace(window=31, stray_light="discard")
        optics = TiDyOptics(NoMask(23), lens="single-50mm", fidelity=fidelity)
        corner = optics.lens.field / optics.camera.pixel_pitch
        bank = optics.psf_bank(defocus=[0.0], field=[(0.0, 0.0), (0.0, corner)])
        table = rows(capsys.readouterr().out)
        assert [row[0] for row in table] == ["0.00"] * 3 + ["6.78"] * 3
        for row, own, light in zip(table, bank.psfs.flatten(0, 2), bank.light.flatten(), strict=True):
            percent = [float(word) for word, unit in pairwise(row) if unit == "%"]
            assert percent[0] == pytest.approx(100 * float(light), abs=0.6)
            assert percent[1] == pytest.approx(100 * float(own.sum() / light), abs=0.06)
            assert percent[2] == pytest.approx(100 * float(own.max() / light), abs=0.006)
        assert read_image(path).shape[2] == 1280

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["--lens", "a.zmx"], "a.zmx must say its largest field, in angles or in heights on the sensor"),
            (["--lens", "a.zmx", "--focal-length", "0.04"], "the lens a.zmx has its own: leave out --focal-length"),
            ([], "there is no camera: give CAMERA, --lens, or both"),
            (["--lens", "single-5mm"], "--lens must be one of 'double-gauss-50mm', 'triplet-50mm'"),
            (["--lens", "a.lens", "--f-number", "8"], "the lens a.lens has its own: leave out --f-number"),
            (["tidy-5", "--field", "3", "--fidelity", "draft"], "--field is for a camera with a lens, and tidy-5 has"),
            (["camera.safetensors", "--lens", "single-50mm"], "camera.safetensors has its own lens"),
            (["--lens", "single-50mm", "--field", "0"], "--field must be a whole number of at least 1, got 0"),
            (["--lens", "single-50mm", "--fidelity", "paper"], "fidelity 'paper' means an ideal lens"),
        ],
    )
    def test_exception_one_sentence_of_a_lens(self, words, sentence, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "a.lens").write_bytes(b"no lens")
        (tmp_path / "a.zmx").write_text(zemax(doublet()).replace("YFLN 0 3.0 6.0", ""))
        (tmp_path / "b.zmx").write_text("no lens")
        save_file(TiDyOptics(fidelity="draft").state_dict(), tmp_path / "camera.safetensors")
        assert sentence in refused(["psf", *words])
        assert not (tmp_path / "psf.png").exists()

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["tidy-9"], "must be one of 'tidy-5', 'tidy-1'"),
            (["tidy-5", "--depths", "nan"], "--depths must be positive metres, got 'nan'"),
            (["tidy-5", "--window", "20"], "window must be an odd number of pixels, got 20"),
            (["tidy-5", "--focus-distance", "2"], "has its own lens"),
            (["tidy-5", "-o", "a.txt"], "suffix of an image file"),
        ],
    )
    def test_exception_one_sentence(self, words, sentence, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        assert sentence in refused(["psf", *words])
        assert list(tmp_path.iterdir()) == []
