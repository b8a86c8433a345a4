from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy import PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.cli import main
from kornia_tidy.data import read_image, read_rgbd, write_depth
from kornia_tidy.data.depth_range import middle_depths
from kornia_tidy.optics import Lens
from kornia_tidy.optics.lens import NAMED_LENSES
from tests.base import BaseTester
from tests.optics.lens.written_files import zemax


def seeded(seed):
    return torch.Generator().manual_seed(seed)


class TestSimulate(BaseTester):
    def test_smoke_writes_beside_nothing_else(self, scene, capsys):
        assert main(["simulate", "image.png", "--depth", "depth.pfm", "--fidelity", "draft"]) == 0
        assert {p.name for p in scene.iterdir()} == {"image.png", "depth.pfm", "image_coded.png"}
        told = capsys.readouterr()
        assert told.err == ""
        for word in ("80 x 72 px", "f/17.6", "5 learnable masks", "px holds red", "no pixel"):
            assert word in told.out

    def test_feature_five_lines_of_python_give_the_same(self, scene):
        assert main(["simulate", "image.png", "--depth", "depth.pfm", "-o", "out.png"]) == 0
        image, depth, _ = read_rgbd("image.png", "depth.pfm")
        masks = PixelwiseMask(5, generator=seeded(0))
        coded = TiDyOptics(masks)(image, depth, generator=seeded(0)).detach()
        assert float((read_image("out.png") - coded).abs().max()) <= 0.5 / 255 + 1e-6
        assert float((image - coded).abs().mean()) > 0.05  # it did something

    @pytest.mark.takes_seconds
    @pytest.mark.filterwarnings("ignore:.*beyond the camera's range:UserWarning")
    @pytest.mark.parametrize("lens", ["single-50mm", "own.safetensors", "lens.zmx"])
    def test_feature_a_real_lens_by_name_table_or_surfaces(self, scene, lens, capsys):
        single = NAMED_LENSES["single-50mm"]["prescription"]
        (scene / "lens.zmx").write_text(zemax(single))
        made = Lens.named("single-50mm", 12.0, 0.7, field=1e-3)
        made.save(scene / "own.safetensors")
        words = [] if lens == "own.safetensors" else ["--f-number", "12", "--focus-distance", "0.7"]
        options = ["--lens", lens, *words, "--fidelity", "draft", "-o", "out.png"]
        assert main(["simulate", "image.png", "--depth", "depth.pfm", *options]) == 0
        image, depth, _ = read_rgbd("image.png", "depth.pfm")
        optics = TiDyOptics(PixelwiseMask(5, generator=seeded(0)), made.camera(8e-6), lens=made, fidelity="draft")
        coded = optics(image, depth, generator=seeded(0)).detach()
        assert float((read_image("out.png") - coded).abs().max()) <= 1.5 / 255
        assert "50 mm f/12, focus at 0.7 m" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["--lens", "single-50mm", "--focal-length", "0.04"], "has its own: leave out --focal-length"),
            (["--lens", "lens"], "--lens must be one of 'double-gauss-50mm'"),
            (["--lens", "own.safetensors", "--fit-depth"], "own.safetensors has its own: leave out --fit-depth"),
            (["--lens", "single-50mm", "--psfs", "bank"], "leave out --lens"),
            (["--masks", "five"], "--masks is a number or a file (.npy, .safetensors): there is no file five"),
            (["-o", ""], "--output must be a name, got an empty one"),
            (["-o", 300 * "x" + ".png"], "xxx...: the name is too long"),
        ],
    )
    def test_exception_of_a_lens(self, scene, words, sentence, refused):
        (scene / "own.safetensors").write_bytes(b"no lens")
        assert sentence in refused(["simulate", "image.png", "--depth", "depth.pfm", *words])

    @pytest.mark.filterwarnings("ignore:.*beyond the camera's range:UserWarning")
    def test_feature_a_scene_all_beyond_the_range_is_told_in_plain_numbers(self, scene, capsys):
        write_depth("near.pfm", torch.full_like(read_rgbd("image.png", "depth.pfm").depth, 0.01))
        assert main(["simulate", "image.png", "--depth", "near.pfm", "-o", "out.png"]) == 0
        assert "(100 %) lie beyond the camera's range" in capsys.readouterr().out

    @pytest.mark.filterwarnings("always")
    @pytest.mark.parametrize("compositing", ["scatter", "occlusion"])
    def test_feature_every_option_reaches_the_camera(self, scene, capsys, compositing):
        options = (
            "--bits 16 --masks 2 --mask-seed 7 --seed 8 --noise 0.02 --fidelity draft --border valid "
            "--color-space linear --focal-length 0.04 --aperture-diameter 0.002 --focus-distance 0.8 "
            f"--depth-range 0.5 8 --pixel-pitch 1e-5 --compositing {compositing}"
        )
        assert main(["simulate", "image.png", "--depth", "depth.pfm", "-o", "out.png", *options.split()]) == 0
        assert "beyond the camera's range -6.67 to +4.45" in capsys.readouterr().err
        image, depth, _ = read_rgbd("image.png", "depth.pfm")
        with pytest.warns(UserWarning, match="beyond the camera's range"), torch.no_grad():
            coded = TiDyOptics(
                PixelwiseMask(2, generator=seeded(7)),
                camera=ThinLensCamera(0.04, 0.002, 0.8, 1e-5, (0.5, 8.0)),
                sensor=SensorNoise(0.02),
                fidelity="draft",
                compositing=compositing,
                border="valid",
                color_space="linear",
            )(image, depth, generator=seeded(8))
        self.assert_close(read_image("out.png"), coded, rtol=0, atol=0.5 / 65535 + 1e-6)

    @pytest.mark.filterwarnings("always")
    def test_feature_fitted_camera_has_the_scene_in_its_range(self, scene, capsys):
        depth = torch.linspace(2, 3, 72 * 80).view(1, 72, 80)
        write_depth("far.pfm", depth)
        assert main(["simulate", "image.png", "--depth", "far.pfm", "--fidelity", "draft", "--fit-depth"]) == 0
        told = capsys.readouterr().out
        assert "psi +20.00 to -20.00" in told
        clamped = int(told.split("clamped")[1].split(" of ")[0])
        assert 0.008 * depth.numel() <= clamped <= 0.011 * depth.numel()  # half a percent at either end

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            ("missing.png --depth depth.pfm", "cannot read missing.png: there is no such file"),
            ("image.png --depth small.pfm", "image and depth must have the same size"),
            ("image.png --depth depth.pfm --focal-length 0.7", "focus_distance must be beyond the focal length"),
            ("image.png --depth depth.pfm --focus-distance inf", "needs depth_range"),
            ("image.png --depth depth.pfm --fit-depth --focus-distance 1", "--fit-depth chooses --focus-distance"),
            ("image.png --depth flat.pfm --fit-depth", "a scene with a range of depths is needed, this one lies at"),
            ("image.png --depth depth.pfm -o nowhere/out.png", "there is no folder nowhere"),
            ("image.png --depth depth.pfm -o image.png", "cannot write image.png: it is an input"),
        ],
    )
    def test_exception_is_one_sentence_and_nothing_is_written(self, arguments, sentence, scene, refused):
        write_depth("small.pfm", torch.ones(1, 8, 8))
        write_depth("flat.pfm", torch.ones(1, 72, 80))
        before = {p: p.stat().st_mtime_ns for p in scene.iterdir()}
        assert sentence in refused(["simulate", *arguments.split()])
        assert {p: p.stat().st_mtime_ns for p in scene.iterdir()} == before


class TestMiddleDepths(BaseTester):
    def test_feature_half_a_percent_of_outliers_does_not_count(self):
        depth = torch.full((1, 1000), 2.0)
        depth[0, :500] = 1.0
        depth[0, 0], depth[0, -1] = 0.01, 1000.0
        assert middle_depths(depth, torch.ones_like(depth, dtype=torch.bool)) == (1.0, 2.0)

    def test_feature_filled_holes_do_not_count(self):
        depth = torch.tensor([[0.1, 1.0, 2.0, 50.0]])
        assert middle_depths(depth, torch.tensor([[False, True, True, False]])) == (1.0, 2.0)

    def test_feature_a_sky_is_part_of_the_scene(self):
        depth = torch.from_numpy(np.repeat([1.0, math.inf], 50))[None]
        assert middle_depths(depth, depth > 0) == (1.0, math.inf)

    def test_exception_one_depth(self):
        with pytest.raises(ValueError, match="this one lies at 2 m"):
            middle_depths(torch.full((1, 9), 2.0), torch.ones(1, 9, dtype=torch.bool))
