"""A measured camera and a measured noise in every command that takes a camera: the same files, the same two options."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import dead_leaves, read_image, read_rgbd, write_depth, write_image
from kornia_tidy.lab.calibration.psf import MeasuredPSFs, measured_camera
from kornia_tidy.lab.measured import closed_form_system
from kornia_tidy.lab.raw import RawCapture, RawInfo, develop, simulate_scene
from kornia_tidy.lab.raw.developed_noise import developed_noise
from kornia_tidy.lab.raw.dng_writer import write_dng
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.coded_datasets import CodedCaptures
from tests.base import BaseTester
from tests.cli.commands.test_raw_reconstruct import checkpoint
from tests.measured import measured_noise, measured_psfs, sweep, write_measurements

PSFS, NOISE = ["--psfs", "bank.safetensors"], ["--noise", "noise.json"]
MEASURED = [*PSFS, *NOISE]
AT_ONE_METRE = ["--distances", "1", "-o", "b.safetensors"]
LENS = {"depth_range": (0.4, 2.5), "f_number": 50e-3 / 2.835e-3, "focus_distance": 0.595}
SCENE = ["--depth", "depth.png", "--depth-scale", "0.001"]


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """The files of a laboratory: measurements, a scene, and a raw file of it by the camera that was measured."""
    folder = tmp_path_factory.mktemp("laboratory")
    write_measurements(folder)
    image, depth = dead_leaves(96, 128, depth_range=(0.4, 2.5), num_leaves=60, seed=3)
    write_image(folder / "scene.png", image)
    write_depth(folder / "depth.png", depth, scale=0.001)
    sensor = RawCapture.from_counts(torch.zeros(1, 2, 2), "RGGB", 256, 4095, RawInfo(iso=800.0))
    sensor = replace(sensor, camera_to_srgb=torch.eye(3), white_balance=torch.ones(4))
    shot = simulate_scene(
        image,
        depth,
        sweep(sensor=None),
        sensor,
        measured_noise().sensor_noise(),
        color="channels",
        generator=torch.Generator().manual_seed(0),
    )
    write_dng(folder / "shot.dng", replace(shot, info=RawInfo(iso=800.0)))
    write_dng(folder / "iso100.dng", replace(shot, info=RawInfo(iso=100.0)))
    grey = RawCapture.from_counts(shot.counts, None, 256, 4095, RawInfo(iso=800.0))
    write_dng(folder / "grey.dng", grey)
    return folder


@pytest.fixture
def here(laboratory, tmp_path, monkeypatch):
    """An empty folder for results, beside links to the files."""
    for path in laboratory.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestRawReconstruct(BaseTester):
    def test_feature_a_photograph_is_restored_by_what_was_measured(self, here, capsys):
        assert main(["raw", "reconstruct", "shot.dng", *MEASURED, "-o", "sharp"]) == 0
        assert "any-camera" in capsys.readouterr().out
        raw = RawCapture.open("shot.dng")
        sensor = developed_noise(raw, None, measured_noise().sensor_noise())
        light = develop(raw, encoded=False, upright=False)
        system = closed_form_system(MeasuredPSFs.load("bank.safetensors"), sensor)
        found, scene = read_image("sharp/shot.png"), read_image("scene.png")
        assert (found - reconstruct_light(LightHead(system), light).image).abs().max() <= 0.5 / 65535 + 1e-6
        capture = system.optics.encode(light[None].clamp(0, 1))
        assert float(psnr(found[None], scene[None])) > float(psnr(capture, scene[None])) + 3
        record = json.loads((here / "sharp" / "shot.json").read_text())
        assert record["psfs"] == "measured: bank.safetensors"
        assert record["noise"] == sensor.extra_repr()

    def test_feature_what_was_measured_at_several_places(self, here):
        """Alike in both: as at one place. The other commands read the file as this one and simulate do."""
        one = MeasuredPSFs.load("bank.safetensors")
        MeasuredPSFs.over_field([one, one], [(0, 0), (0, 40)]).save("field.safetensors")
        found = []
        for file in ("bank.safetensors", "field.safetensors"):
            words = ["shot.dng", "--head", "tikhonov", "--psfs", file, *NOISE]
            assert main(["raw", "reconstruct", *words, "-o", file[:4]]) == 0
            assert main(["simulate", "scene.png", *SCENE, "--psfs", file, "-o", f"{file[:4]}.png"]) == 0
            found.append((read_image(f"{file[:4]}/shot.png"), read_image(f"{file[:4]}.png")))
        for one_place, several in zip(*found, strict=True):
            self.assert_close(one_place, several, rtol=0, atol=2 / 255)

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["shot.dng"], "a system is needed: one of joint-uncertain,"),
            (["shot.dng", "--head", "wiener"], "the head 'wiener' needs the PSFs of a camera: give --psfs"),
            (["shot.dng", "--psfs", "bank.safetensors"], "the noise of shot.dng is not known: give --noise"),
            (["iso100.dng", *MEASURED], "the noise was measured at ISO 800, and iso100.dng was taken at ISO 100"),
            (["grey.dng", *MEASURED], "the PSFs were measured in 3 colours, and grey.dng has 1"),
            (["shot.dng", "--psfs", "noise.json", "--noise", "0.01"], "noise.json"),
            (["shot.dng", *PSFS, "--noise", "bank.safetensors"], "not a readable noise calibration"),
            (["shot.dng", "--head", "edof-5", *MEASURED], "the network is for depths from 0.2975 to inf m"),
            (["shot.dng", "--head", "plain.safetensors", *PSFS], "--psfs is for a network that deconvolves"),
        ],
    )  # fmt: skip
    def test_exception_is_one_sentence(self, here, arguments, sentence, refused):
        checkpoint(here / "plain.safetensors", task="edof", **LENS)
        assert sentence in refused(["raw", "reconstruct", *arguments, "-o", "out"])
        assert not list(here.glob("out/*.png"))


class TestCaptures(BaseTester):
    def test_feature_simulate_takes_the_pictures_of_the_measured_camera(self, here):
        assert main(["simulate", "scene.png", *SCENE, *MEASURED, "--seed", "3", "-o", "coded.png", "--bits", "16"]) == 0
        scene = read_rgbd("scene.png", "depth.png", scale=0.001)
        optics = measured_camera("bank.safetensors", sensor=measured_noise().sensor_noise())
        coded = optics(scene.image, scene.depth, generator=torch.Generator().manual_seed(3))
        assert (read_image("coded.png") - coded).abs().max() <= 0.5 / 65535 + 1e-6

    def test_feature_flats_and_points_can_be_calibrated(self, here, capsys):
        flats = []
        for number, level in enumerate(("0", "0", "0.2", "0.2", "0.7", "0.7")):
            flats.append(f"flat{number}.dng")
            more = ["--size", "128x96", "--seed", str(number), "--noise", "noise.json", "-o", flats[-1]]
            assert main(["raw", "simulate", "--flat", level, *more]) == 0
        assert main(["raw", "calibrate-noise", *flats, "-o", "again.json"]) == 0
        assert json.loads((here / "again.json").read_text())["line"]["gain"] == pytest.approx(2.7, rel=0.1)
        points = ["--points", "2", "--distance", "0.6", "--size", "64x32", "--pattern", "rggb", "-o", "points.dng"]
        assert main(["raw", "simulate", *points]) == 0
        counts = RawCapture.open("points.dng").counts[0].float() - 256
        assert 0.1 * 3839 < float(counts.max()) < 0.85 * 3839  # the brightest may lie behind another filter

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["simulate", "scene.png", *SCENE, *MEASURED, "--pixel-pitch", "3e-6"], "leave out --pixel-pitch"),
            (["simulate", "scene.png", *SCENE, *MEASURED, "--masks", "5"], "leave out --masks"),
            (["simulate", "scene.png", *SCENE, *MEASURED, "--mask-seed", "0"], "leave out --mask-seed"),
            (["simulate", "scene.png", *SCENE, "--psfs", "grey.safetensors"], "have 1 channels, not 3"),
            (["simulate", "scene.png", *SCENE, "--masks", "m.npy", "--mask-seed", "1"], "leave one of them out"),
            (["raw", "simulate", "--image", "scene.png", "-o", "a.dng"], "--image and --depth go together"),
            (["raw", "simulate", "--points", "2", "-o", "a.dng"], "--points and --distance go together"),
            (["raw", "simulate", "--flat", "2", "-o", "a.dng"], "--flat must be a number from 0 to 1"),
            (["raw", "simulate", "--image", "scene.png", *SCENE, "--size", "9x9", "-o", "a.dng"], "--size is of"),
            (["raw", "simulate", "--points", "1", "--distance", "1", *MEASURED, "-o", "a.dng"], "between pixels"),
            (["raw", "simulate", "--flat", "0", "--like", "iso100.dng", *NOISE, "-o", "a.dng"], "at ISO 800"),
            (["raw", "calibrate-psf", "scene.png", *AT_ONE_METRE], "the noise of the sensor is needed"),
            (["raw", "calibrate-psf", "iso100.dng", *AT_ONE_METRE, *NOISE], "at ISO 800"),
            (["train", *MEASURED, "--masks", "3"], "leave out --masks"),
            (["train", *MEASURED, "--design-from", "x"], "leave out --design-from"),
            (["train", *MEASURED, "--learn", "masks"], "needs masks to learn"),
            (["render", "--preset", "tidy-1", *MEASURED, "-o", "r"], "--psfs does not go with --preset"),
            (["render", "--checkpoint", "x", "--noise", "0.1", "-o", "r"], "--noise does not go with --checkpoint"),
            (["evaluate", "wiener"], "needs the PSFs of a camera: give --psfs"),
        ],
    )  # fmt: skip
    def test_exception_is_one_sentence_and_nothing_is_written(self, here, arguments, sentence, refused):
        measured_psfs(1).save(here / "grey.safetensors")
        before = set(here.iterdir())
        assert sentence in refused(arguments)
        assert set(here.iterdir()) == before


class TestSystems(BaseTester):
    def test_feature_render_photographs_a_data_set_through_them(self, here):
        assert main(["render", *MEASURED, "--scenes", "1", "--size", "40", "--float", "-o", "captures"]) == 0
        sample = CodedCaptures("captures")[0]
        optics = measured_camera("bank.safetensors", sensor=None)
        plain = optics(sample["image"], sample["depth"])
        noise_of = measured_noise().sensor_noise().std(optics.decode(plain[None]))
        left = (optics.decode(sample["coded"][None]) - optics.decode(plain[None])) / noise_of
        assert float(left.std()) == pytest.approx(1, abs=0.1)  # 4,800 values; the brightest are clipped
        text = (here / "captures" / "render.json").read_text()
        assert "full_well" in text
        assert "psfs" in text

    @pytest.mark.takes_seconds
    @pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")  # Lightning
    def test_feature_a_network_learns_behind_them_and_its_checkpoint_needs_no_file(self, here, refused):
        pytest.importorskip("lightning.pytorch")
        small = ["--head", "plain", "--width", "4", "--size", "40", "--scenes", "4", "--validation-scenes", "1"]
        small += ["--batch", "2", "--epochs", "1", "--closed-form"]
        assert main(["train", "--learn", "network", *MEASURED, *small, "-o", "run"]) == 0
        other = measured_psfs()
        replace(other, bank=replace(other.bank, psfs=other.bank.psfs.flip(-1))).save("other.safetensors")
        (here / "bank.safetensors").unlink()
        resume = ["train", "--resume", "--epochs", "2", "-o", "run"]
        assert "its PSFs are not those that are given" in refused([*resume, "--psfs", "other.safetensors"])
        assert main(resume) == 0
        system = load_trained("run/best.safetensors")
        assert torch.equal(system.optics.psf_bank().psfs, measured_psfs().bank.psfs)
        assert system.optics.sensor.extra_repr() == measured_noise().sensor_noise().extra_repr()
        assert main(["raw", "reconstruct", "shot.dng", "--head", "run/best.safetensors", *NOISE, "-o", "out"]) == 0
        assert main(["evaluate", "run/best.safetensors", "--scenes", "1"]) == 0

    def test_feature_a_closed_form_is_scored_without_training(self, here, capsys):
        pytest.importorskip("lightning.pytorch")
        assert main(["evaluate", "tikhonov", *MEASURED, "--scenes", "1", "--size", "40", "-o", "scores"]) == 0
        assert "image_psnr" in capsys.readouterr().out
        summary = json.loads((here / "scores" / "summary.json").read_text())
        assert (summary["psfs"], summary["noise"]) == ("bank.safetensors", "noise.json")
