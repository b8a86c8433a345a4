from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy import PixelwiseMask, PSFBank, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.cli import main
from kornia_tidy.data import write_image
from kornia_tidy.lab.calibration.psf import MeasuredPSFs
from kornia_tidy.masks import fisher_mask
from tests.base import BaseTester
from tests.lab.calibration.psf.captures import exposed, on_pixels, planes, point_light

WINDOW, SIDE, CAMERA = 15, 62, ThinLensCamera()
NOISE = ["--full-well", "10500", "--read-noise", "2.4", "--window", str(WINDOW)]
PLACES = ((0, 0), (21, -22), (-21, 20), (22, 22), (-20, -21), (19, 21))  # ninths of a pixel


@pytest.fixture(scope="module")
def lights():
    """Ninths of pixels, by distance, of one channel and in colours."""
    masks = PixelwiseMask(1, initial=fisher_mask())
    return {
        z: point_light(masks, float(CAMERA.defocus(torch.tensor(z))), SIDE - 1, Spectrum.rgb(), CAMERA)
        for z in (0.5, 0.8)
    }


def frame(fine, ninths, exposure, seed):
    light = on_pixels(fine, ninths)
    light = torch.nn.functional.pad(0.4 * light / light.max(), (0, 1, 0, 1))
    return exposed(light, torch.tensor([exposure]), torch.Generator().manual_seed(seed), 10500, 2.4, 0.01)[0]


@pytest.fixture
def grey(lights, tmp_path, monkeypatch):
    """Green alone at two distances, as 16-bit PNG."""
    monkeypatch.chdir(tmp_path)
    names = []
    for z in (0.8, 0.5):
        for n, ninths in enumerate(PLACES):
            names.append(f"p{z}-{n}.png")
            write_image(names[-1], frame(lights[z][1:2], ninths, 1.0, n), bits=16)
    return names


def write_dump(path, channels):
    """Counts of an RGGB sensor of 12 bits."""
    mosaic = torch.empty(SIDE, SIDE)
    for k, plane in enumerate(planes(channels, ((0, 1), (1, 2)))):
        mosaic[k // 2 :: 2, k % 2 :: 2] = plane
    (mosaic * 4031 + 64).round().clamp(0, 4095).numpy().astype(np.uint16).tofile(path)


class TestCalibratePSF(BaseTester):
    def test_smoke_from_images_to_a_bank_and_a_picture(self, grey, tmp_path, capsys):
        more = ["--distances", "0.8", "0.5", "-o", "bank.safetensors"]
        assert main(["raw", "calibrate-psf", *grey, *NOISE, *more]) == 0
        told = capsys.readouterr()
        assert told.err == ""
        for word in ("6 point images", "residuals", "% in L1", "bring it to 2%", "bank.safetensors", "bank.png"):
            assert word in told.out
        measured = MeasuredPSFs.load("bank.safetensors")
        assert measured.distances.tolist() == [0.8, 0.5]
        assert len(measured.reports) == 12
        assert (tmp_path / "bank.png").read_bytes()[:4] == b"\x89PNG"

    @pytest.mark.filterwarnings("always")
    def test_feature_dumps_of_a_mosaic_give_a_bank_of_colours_to_look_through(
        self, lights, tmp_path, monkeypatch, capsys
    ):
        monkeypatch.chdir(tmp_path)
        names, references = [], []
        clear = point_light(
            PixelwiseMask(1, initial="flat"), float(CAMERA.defocus(torch.tensor(0.8))), SIDE - 1, Spectrum.rgb(), CAMERA
        )
        for n, (down, right) in enumerate(PLACES):
            ninths = 2 * down, 2 * right  # parts of a plane's pixel
            for exposure in (1.0, 8.0):
                names.append(f"{n}-{exposure:g}.raw")
                write_dump(names[-1], frame(lights[0.8], ninths, exposure, n))
            references.append(f"{n}-flat.raw")
            write_dump(references[-1], frame(clear, ninths, 1.0, n))
        dump = ["--size", f"{SIDE}x{SIDE}", "--pattern", "RGGB", "--black", "64", "--white", "4095"]
        more = ["--distances", "0.8", "--exposures", "1", "8", "-o", "bank.safetensors", "--reference", *references]
        assert main(["raw", "calibrate-psf", *names, *NOISE, *more, *dump]) == 0
        told = capsys.readouterr()
        assert "psi" in told.out
        assert told.err.startswith("kornia-tidy: warning: 6 places of the point at 0.8 m are too few")
        bank = PSFBank.load("bank.safetensors")
        assert bank.psfs.shape == (1, 3, WINDOW, WINDOW)
        inside = slice((SIDE - 1) // 2 - WINDOW // 2, (SIDE - 1) // 2 + WINDOW // 2 + 1)
        truth = on_pixels(lights[0.8])[:, inside, inside]
        truth = truth / truth.sum((1, 2), keepdim=True)
        error = (bank.psfs[0] - truth).abs().sum((1, 2))
        assert float(error[:2].max()) < 0.08  # of six places; blue's aliases, up to twice Nyquist, need more
        optics = TiDyOptics(camera=CAMERA, sensor=None).with_bank(bank)
        assert optics(torch.rand(3, 40, 40), torch.full((1, 40, 40), 0.8)).shape == (3, 40, 40)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--distances", "0.8", "0.5", "-o", "bank.npz"], "the suffix of what to write"),
            (["--distances", "0.8", "0.5", "-o", "none/b.safetensors"], "there is no folder none"),
            (["--distances", "0.8", "0.8", "-o", "b.safetensors"], "--distances must be different metres"),
            (["--distances", "1", "2", "3", "4", "5", "-o", "b.safetensors"], "12 files do not divide into 5"),
            (
                ["--distances", "0.8", "0.5", "-o", "b.safetensors", "--reference", "p0.8-0.png"],
                "--reference needs one file",
            ),
            (["--distances", "0.8", "0.5", "-o", "b.safetensors", "--picture", "p0.8-0.png"], "it is an input"),
            (["--distances", "0.8", "-o", "b.safetensors", "--fit-mask", "m.npy"], "--fit-mask needs two distances"),
            (["--distances", "0.8", "0.5", "-o", "b.safetensors", "--window", "20"], "window must be odd"),
            (["--distances", "0.8", "0.5", "-o", "b.safetensors", "--window", "61"], "the background needs 32 pixels"),
        ],
    )
    def test_exception_is_one_sentence_and_nothing_is_written(self, grey, tmp_path, capsys, arguments, message):
        before = set(tmp_path.iterdir())
        assert main(["raw", "calibrate-psf", *grey, *NOISE, *arguments]) == 2
        told = capsys.readouterr().err
        assert message in told
        assert len(told.strip().splitlines()) == 1
        assert set(tmp_path.iterdir()) == before
