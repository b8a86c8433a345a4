"""Examples in the help of commands: Python is run, commands that take a second are run, the others are read.

That the others are read is tested by ``test_registry.py``, with all examples.
"""

from __future__ import annotations

import re
import shlex
import shutil
import textwrap

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.cli import main
from kornia_tidy.data import dead_leaves, write_depth, write_image
from kornia_tidy.lab.mask_export import write_heights
from kornia_tidy.lab.raw.dng_writer import write_dng
from kornia_tidy.lab.raw.simulation import simulate_raw, simulated_sensor
from kornia_tidy.settings import documented, section
from kornia_tidy.training.coded_datasets import render_scenes
from tests.base import BaseTester
from tests.cli.commands.test_registry import ALL
from tests.measured import measured_noise, write_measurements

CHEAP = {("simulate",), ("psf",), ("masks", "export"), ("raw", "info"), ("raw", "develop"), ("raw", "simulate")}
NOT_HERE = ("disp0.pfm", "runs/", "lens.zmx", "quicktake/", "shot.cr2", "--field")  # files, and half a minute


def said(command):
    return f"{documented(command)[1]}\n{section(command, 'Notes')}\n"


def python_in(text):
    """Return the indented Python of a help text."""
    blocks = re.findall(r"Python[^\n]*:\n((?:  +[^\n]*\n)+)", text)
    return "\n".join(textwrap.dedent(block) for block in blocks)


def commands_in(command):
    """Yield the words of the commands in the examples that can be run here."""
    text = re.sub(r"\\\n\s*", "", section(command, "Examples"))
    for line in text.splitlines():
        if line.strip().startswith("kornia-tidy ") and not any(name in line for name in NOT_HERE):
            yield re.split(r"   | [>|] ", line.strip(), maxsplit=1)[0]


LINES = [line for words in sorted(CHEAP) for line in commands_in(ALL[words])]
SNIPPETS = {" ".join(words): python for words, command in ALL.items() if (python := python_in(said(command)))}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """All files that the examples name, small."""
    folder = tmp_path_factory.mktemp("examples")
    write_measurements(folder)
    shutil.copy(folder / "noise.json", folder / "iso800.json")
    image, depth = dead_leaves(96, 128, depth_range=(0.6, 2.5), num_leaves=60, seed=3)
    write_image(folder / "rgb.png", image)
    write_depth(folder / "depth.png", depth, scale=0.001)
    write_depth(folder / "depth.pfm", depth)
    for name in ("shots", "pictures"):
        (folder / name).mkdir()
    shot = simulate_raw(image.clamp(0.1, 0.9), simulated_sensor(), measured_noise().sensor_noise(), color="channels")
    write_dng(folder / "shots/shot.dng", shot)
    counts = np.random.default_rng(0).integers(600, 15520, (512, 768))
    counts.astype("<u2").tofile(folder / "dump.raw")
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(0))
    write_heights(folder / "heights.npy", masks.heights().detach())
    save_file(TiDyOptics(masks).state_dict(), folder / "camera.safetensors")
    (folder / "lut.csv").write_text("level,rad\n" + "".join(f"{n},{n * 6.3 / 1023}\n" for n in range(1024)))
    scene = {"image": image, "depth": depth}
    render_scenes(TiDyOptics(masks), [scene], folder / "captures")
    return folder


@pytest.fixture
def here(files, tmp_path, monkeypatch):
    """A copy of the files, in which the examples write."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestHelpExamples(BaseTester):
    @pytest.mark.parametrize("words", SNIPPETS)
    def test_smoke_python_runs(self, words, here):
        image, depth = dead_leaves(96, 128, depth_range=(0.6, 2.5), num_leaves=60, seed=3)
        exec(SNIPPETS[words], {"image": image, "depth": depth, "capture": image[None]})

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("line", LINES)
    def test_smoke_commands_run(self, line, here, capsys):
        argv = []
        for word in shlex.split(line)[1:]:
            argv += sorted(str(path.relative_to(here)) for path in here.glob(word)) if "*" in word else [word]
        assert main(argv) == 0, capsys.readouterr().err

    def test_feature_there_are_examples_of_both_kinds(self):
        assert len(SNIPPETS) >= 7
        assert len(LINES) >= 14
