from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import kornia_tidy
from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.design.tradeoff import Conditions, conditions
from kornia_tidy.design.tradeoff.conditions import code_hash, device_name, measured_files, scene_hash
from tests.base import BaseTester
from tests.design.tradeoff.samples import CONDITIONS

IMAGE, DEPTH = torch.rand(3, 8, 8), torch.ones(1, 8, 8)
QUICK = Fidelity(window=9)


def optics(**parts):
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(parts.pop("seed", 0)))
    return TiDyOptics(masks, **{"fidelity": QUICK, **parts})


class TestSceneHash(BaseTester):
    def test_feature_is_the_same_for_the_same_and_for_what_does_not_matter(self):
        first = scene_hash(optics(), IMAGE, DEPTH)
        assert first == scene_hash(optics(), IMAGE.clone(), DEPTH)
        assert first == scene_hash(optics(fidelity="draft", sensor=SensorNoise(0.5)).eval(), IMAGE, DEPTH)

    @pytest.mark.parametrize(
        "parts",
        [
            {"seed": 1},
            {"camera": ThinLensCamera(pixel_pitch=8.0001e-6)},
            {"camera": ThinLensCamera(focus_distance=torch.tensor(0.595))},
            {"compositing": "scatter"},
            {"border": "zero"},
            {"color_space": "linear"},
            {"aperture": torch.ones(23, 23)},
        ],
        ids=str,
    )
    def test_feature_tells_every_part_of_the_camera(self, parts):
        assert scene_hash(optics(**parts), IMAGE, DEPTH) != scene_hash(optics(), IMAGE, DEPTH)

    def test_feature_tells_image_and_depth(self):
        hashes = {
            scene_hash(optics(), image, depth)
            for image, depth in ((IMAGE, DEPTH), (IMAGE + 1e-6, DEPTH), (IMAGE, DEPTH + 1e-6), (IMAGE.double(), DEPTH))
        }
        assert len(hashes) == 4


class TestConditions(BaseTester):
    def test_smoke_here_and_now(self):
        here = Conditions.here_and_now("a scene", optics(), IMAGE, DEPTH)
        assert (here.height, here.width, here.channels, here.masks) == (8, 8, 3, 2)
        assert here.torch == torch.__version__
        assert here.date.endswith("+00:00")
        assert here.same(Conditions.here_and_now("another name", optics(), IMAGE, DEPTH))

    @pytest.mark.parametrize(
        ("change", "same"),
        [
            ({"date": "2030-01-01T00:00:00+00:00"}, True),
            ({"commit": "abc"}, True),
            ({"scene": "renamed"}, True),
            ({"scene_hash": "0"}, False),
            ({"code_hash": "0"}, False),
            ({"threads": 1}, False),
            ({"device": "another"}, False),
            ({"torch": "2.5.1"}, False),
            ({"reference": "balanced"}, False),
        ],
    )
    def test_feature_which_rows_may_stand_side_by_side(self, change, same):
        assert CONDITIONS.same(replace(CONDITIONS, **change)) is same

    def test_feature_the_code_is_that_of_a_capture(self, tmp_path, monkeypatch):
        before = code_hash()
        copy = tmp_path / "kornia_tidy"
        shutil.copytree(Path(kornia_tidy.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
        monkeypatch.setattr(conditions, "PACKAGE", copy)
        assert code_hash() == before
        (copy / "figures.py").write_text("")
        assert code_hash() == before
        hashes = {before}
        for name in (
            "render/layers.py",
            "kernels/direct.c",
            "kernels/occlusion.c",
            "kernels/mutual_intensity.c",
            "kernels/vectors.h",
            "kernels/build.py",
            "masks/base.py",
            "sensor/sensor.py",
            "accuracy/planner.py",
            "accuracy/error_model.py",
            "design/tradeoff/sweep_settings.py",
        ):
            (copy / name).write_text("")
            assert code_hash() not in hashes, name
            hashes.add(code_hash())

    @pytest.mark.takes_seconds
    def test_feature_all_that_a_measurement_imports_is_in_the_hash(self):
        """But for what draws, writes or names, and for other ways to take pictures, which no row comes from."""
        script = "import sys, kornia_tidy.design.tradeoff.measure, kornia_tidy.accuracy.planner; print(*sys.modules)"
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, text=True)
        root = Path(kornia_tidy.__file__).parent
        elsewhere = {"camera/dataset_transform", "files", "camera/motion", "camera/burst", "tensor_files", "__init__"}
        elsewhere |= {
            "design/tradeoff/conditions",
            "design/tradeoff/files",
            "design/tradeoff/__init__",
        }
        elsewhere |= {"choices", "seeds", "settings", "lazy", "version", "signals", "search_path", "design/__init__"}
        names = {
            name.partition(".")[2].replace(".", "/") for name in done.stdout.split() if name.startswith("kornia_tidy.")
        }
        files = {root / f"{name}.py" for name in names if not name.startswith("figures")} - {
            root / f"{name}.py" for name in elsewhere
        }
        files = {path for path in files if path.is_file()}
        assert len(files) > 30
        assert files <= set(measured_files(root))

    def test_smoke_device_name(self):
        assert device_name(torch.device("cpu")).endswith("CPUs")
