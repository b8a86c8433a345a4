"""What the tests of commands share: a scene on disk, and commands that end with one sentence."""

from __future__ import annotations

import math

import pytest

from kornia_tidy.cli import main
from kornia_tidy.data import dead_leaves, write_depth, write_image


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A small dead-leaves scene on disk, in the folder in which the command runs."""
    image, depth = dead_leaves(72, 80, depth_range=(0.3, math.inf), num_leaves=200, seed=3)
    write_image(tmp_path / "image.png", image)
    write_depth(tmp_path / "depth.pfm", depth)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(capsys):
    """Run a command that ends with status 2 and one sentence, or one and how many files failed; returns the first."""

    def run(argv):
        capsys.readouterr()
        assert main(argv) == 2
        told = capsys.readouterr().err
        sentence, *rest = (line for line in told.splitlines() if line.startswith("kornia-tidy: error: "))
        assert all("failed" in line for line in rest), rest
        assert "Traceback" not in told
        return sentence

    return run
