"""Training on an accelerator: the program in ``tests/benchmarks``, on tiny scenes and the processor."""

from __future__ import annotations

import copy
import importlib.util
import json
import sys
from argparse import Namespace

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.nafnet import NAFNet
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.settings import TrainingSettings
from kornia_tidy.training.task_loss import psnr_ssim_loss
from tests.base import BaseTester
from tests.benchmarks import accelerated_training as program

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None or not torch.cuda.is_available(),
    reason="no CUDA card is here, or no Triton, which PyTorch for CUDA brings along",
)


@pytest.fixture
def tiny(monkeypatch):
    """Scenes of 80 px, two in a file: the border of PSFs of 129 px needs 65."""
    monkeypatch.setattr(program, "SIZE", 80)
    monkeypatch.setattr(program, "CHUNK", 2)


@pytest.fixture
def photographs(tmp_path):
    """A folder with one photograph."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    assert cv2.imwrite(str(folder / "noise.png"), noise)
    return folder


def command(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["accelerated_training", *map(str, words)])
    program.main()


class TestProgram(BaseTester):
    @pytest.mark.slow
    def test_smoke_scenes_are_painted_and_systems_learn_from_them(self, tiny, photographs, tmp_path, monkeypatch):
        scenes, out = tmp_path / "scenes", tmp_path / "out"
        command(monkeypatch, "paint", "--root", photographs, "--scenes", scenes, "--count", 4, "--processes", 1)
        # Processes that are spawned know the usual sizes.
        for path in scenes.glob("*.npy"):
            planes = np.load(path)
            assert planes.shape == (32, 4, 256, 256)
            np.save(path, np.ascontiguousarray(planes[:2, :, :80, :80]))
        words = ["--device", "cpu", "--batch", 2, "--first", 1, "--seconds", 8, "--scenes", scenes, "-o", out]
        command(monkeypatch, "learn", "edof-designed", "edof-flat", *words)
        steps = {}
        for name in ("edof-designed", "edof-flat"):
            command(monkeypatch, "unpack", out / name)
            system = load_trained(out / name / "best.safetensors")
            steps[name] = system.step
            assert TrainingSettings.read(out / name / "settings.json").batch == 2
            assert json.loads((out / f"{name}.json").read_text())["validation"][0]["step"] == 0
            assert "val_psnr_57000e" in (out / name / "validation.csv").read_text().splitlines()[0]
        assert steps["edof-designed"] == steps["edof-flat"] > 0
        words = [*words[:-1], tmp_path / "more", "--begin", out, "--steps", 2, "--mask-share", 0.5, "--fine"]
        del words[words.index("--seconds") :][:2]
        command(monkeypatch, "learn", "edof-designed", *words)
        more = load_trained(tmp_path / "more" / "edof-designed.safetensors")
        assert (more.step, more.settings.fine) == (2, True)

    def test_feature_masks_move_for_their_share_of_the_time_and_then_stay(self, tiny, tmp_path):
        run = self.run_of("edof-designed", tmp_path)
        before = run.optics.masks.phase.detach().clone()
        run.step(0.2)
        moved = run.optics.masks.phase.detach().clone()
        assert not torch.equal(moved, before)
        run.step(0.9)
        assert torch.equal(run.optics.masks.phase, moved)
        assert len(run.light) == 1  # captures are kept from then on

    def test_feature_captures_may_have_what_near_objects_hide(self, tiny, tmp_path):
        runs = [self.run_of("edof-flat", tmp_path, compositing) for compositing in ("gather", "occlusion")]
        assert [run.settings.compositing for run in runs] == ["gather", "occlusion"]
        nearness = (torch.arange(80) < 40).float().expand(1, 1, 80, 80)
        image = nearness.expand(1, 3, 80, 80)  # a white object before a black ground
        plain, occluded = (run.captured(image, nearness) for run in runs)
        assert (plain - occluded)[..., 38:42].abs().max() > 0.01  # 500 times the rounding
        assert torch.allclose(*(run.captured(image, nearness * 0) for run in runs), atol=2e-5)

    def test_feature_a_run_that_fails_with_masks_goes_on_without(self, tiny, tmp_path, monkeypatch, capsys):
        run = self.run_of("edof-designed", tmp_path)
        monkeypatch.setattr(run, "capture", None)
        run.light = [torch.rand(2, 3, 80, 80)]
        assert program._stepped(run, 0.1)
        assert not run.moving
        assert "TypeError" in capsys.readouterr().err
        assert program._stepped(run, 0.1)
        run.light = []
        assert not program._stepped(run, 0.1)

    @staticmethod
    def run_of(name, folder, compositing="gather"):
        scenes = program.Scenes(folder, torch.device("cpu"))
        images, nearness = torch.rand(2, 3, 80, 80).half(), torch.rand(2, 1, 80, 80).half()
        scenes.parts = [(images, nearness)]
        args = Namespace(
            begin=program.FOLDER, batch=2, lr=1e-4, lr_metres=4e-9, ema=0.9, count=2, seed=1, masks=True, fast=False,
            noise_range=None, electrons=None, output=folder, fine=False, mask_share=None,
            compositing=compositing,
        )  # fmt: skip
        run = program.Run(name, scenes, args)
        run.prepare()
        return run


class TestParts(BaseTester):
    def test_feature_the_loss_is_that_of_the_package_in_value_and_gradient(self):
        loss = program.PsnrSsim(torch.device("cpu"))
        estimate, wanted = torch.rand(2, 3, 3, 24, 31, dtype=torch.float64)
        loss.window, loss.matrices = loss.window.double(), {}
        slopes = []
        for of in (loss, lambda one, two: psnr_ssim_loss(one, two, None)):
            one = estimate.clone().requires_grad_()
            of(one, wanted).backward()
            slopes.append(one.grad)
        self.assert_close(slopes[0], slopes[1], rtol=1e-4, atol=1e-7)  # the window is rounded to float32

    def test_feature_noise_has_the_deviation_that_is_told(self):
        """Of 40,000 pixels: their variance is within six of its standard errors."""
        sensors = program.Sensors(
            torch.tensor([0.01, 0.02]).view(2, 1, 1, 1), torch.tensor([200.0, torch.inf]).view(2, 1, 1, 1)
        )
        light = torch.full((2, 1, 200, 200), 0.5)
        noise = sensors(light) - light
        wanted = sensors.std(light)[:, 0, 0, 0]
        error = wanted.square() * (2 / 4e4) ** 0.5 * 1.2  # the kurtosis of Poisson noise is 1 / 100 above the normal's
        assert ((noise.var((1, 2, 3)) - wanted.square()).abs() < 6 * error).all()
        assert wanted.tolist() == pytest.approx([(0.01**2 + 0.5 / 200) ** 0.5, 0.02])

    def test_feature_the_gradient_of_a_noisy_capture_is_that_of_its_light(self):
        sensors = program.Sensors(torch.full((1, 1, 1, 1), 1e-4), torch.full((1, 1, 1, 1), 5e3))
        light = torch.full((1, 1, 8, 8), 0.5, requires_grad=True)
        sensors(light).sum().backward()
        self.assert_close(light.grad, torch.ones_like(light))

    def test_feature_gains_keep_capture_and_scene_within_full_scale(self):
        light, truth = torch.rand(2, 16, 3, 8, 8)
        brighter, wanted = program.with_gain(light, truth)
        assert max(float(brighter.max()), float(wanted.max())) <= 1 + 1e-6
        self.assert_close(brighter / light.clamp(min=1e-6), wanted / truth.clamp(min=1e-6), rtol=1e-3, atol=1e-3)

    def test_feature_encoding_and_decoding_are_inverse(self):
        light = torch.linspace(0, 1, 101).view(1, 1, 1, -1)
        self.assert_close(program.linear(program.encoded(light)), light, rtol=1e-5, atol=1e-6)


@needs_triton
class TestFastBlocks(BaseTester):
    @pytest.mark.parametrize("linear", [True, False])
    def test_feature_gradients_are_nearer_to_float32_than_those_of_plain_bfloat16(self, linear):
        from tests.benchmarks.accelerated_blocks import use_fast_blocks

        torch.manual_seed(0)
        network = NAFNet(26, 3, width=16).to("cuda", memory_format=torch.channels_last)
        network.range_checked = True
        for value in network.parameters():  # blocks are the identity at first
            torch.nn.init.normal_(value, std=0.2) if value.shape[0] == 1 else None
        maps = torch.rand(1, 26, 16, 32, device="cuda")
        slope = torch.randn(1, 3, 16, 32, device="cuda")
        fast = copy.deepcopy(network)
        use_fast_blocks(fast, linear=linear)
        exact = self.gradients(network, maps, slope, half=False)
        off = [float((self.gradients(of, maps, slope) - exact).norm()) for of in (network, fast)]
        assert off[1] < off[0] < 0.3 * float(exact.norm())

    @staticmethod
    def gradients(network, maps, slope, *, half=True):
        with torch.autocast("cuda", torch.bfloat16, enabled=half, cache_enabled=False):
            out = network(maps)
        found = torch.autograd.grad(out.float(), list(network.parameters()), slope)
        return torch.cat([part.float().flatten() / part.float().norm() for part in found])

    def test_feature_the_bilateral_filter_is_that_of_the_package(self):
        from tests.benchmarks.accelerated_blocks import bilateral

        image, color = torch.rand(2, 3, 20, 33, device="cuda"), 0.1 + 0.3 * torch.rand(2, 1, 20, 33, device="cuda")
        self.assert_close(bilateral(image, color, 7, 2.0), bilateral_filter(image, color, 7, 2.0), rtol=1e-5, atol=1e-6)
