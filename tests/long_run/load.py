"""Mixed load: each task trains, renders or reads files once, with sizes and settings drawn anew."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from kornia_tidy import PixelwiseMask, PSFBank, TiDyOptics, cli
from kornia_tidy.data import DeadLeaves, dead_leaves, read_image, read_rgbd, write_depth, write_image
from kornia_tidy.reconstruction import AttentionUNet
from kornia_tidy.reconstruction.state_file import read_state, write_state
from kornia_tidy.training.coded_datasets import CodedCaptures, render_scenes

SIDES = (32, 48, 64, 96)  # pixels


class MixedLoad:
    """Training, rendering and file tasks that take turns.

    Args:
        folder: an empty folder for files.
        seed: of sizes and scenes.
    """

    def __init__(self, folder: Path, seed: int = 0) -> None:
        self.folder, self.generator, self.steps = folder, np.random.default_rng(seed), 0
        masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(seed))
        self.optics = TiDyOptics(masks, fidelity="draft")
        self.head = AttentionUNet(out_channels=4, width=4)
        groups = [*self.optics.parameter_groups(lr_metres=1e-9), {"params": self.head.parameters(), "lr": 1e-3}]
        self.optimizer = torch.optim.Adam(groups)
        self.tasks: tuple[Callable[[], None], ...] = (
            *(self.train,) * 4, self.render, self.save, self.photograph, self.command, self.refuse,
        )  # fmt: skip

    def round(self) -> None:
        """Run every task once; training steps are run four times."""
        for task in self.tasks:
            task()

    def train(self) -> None:
        """Take one step of joint training on a scene of random size."""
        image, depth = self._scene()
        estimate = self.head(self.optics(image[None], depth[None]))
        loss = (estimate[:, :3] - image).square().mean() + (estimate[:, 3:] - 1 / depth).square().mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        self.steps += 1
        if not all(bool(p.isfinite().all()) for group in self.optimizer.param_groups for p in group["params"]):
            raise FloatingPointError(f"a parameter is not finite after step {self.steps}")

    @torch.no_grad()
    def render(self) -> None:
        """Render a scene by a new camera, with a random compositing, border and number of masks."""
        image, depth = self._scene()
        count = int(self.generator.integers(1, 6))
        masks = PixelwiseMask(count, generator=torch.Generator().manual_seed(int(self.generator.integers(2**31))))
        choice = {name: str(self.generator.choice(values)) for name, values in (
            ("compositing", ("gather", "scatter", "occlusion")), ("fidelity", ("draft", "balanced")),
        )}  # fmt: skip
        coded = TiDyOptics(masks, **choice)(image, depth)
        if not bool(coded.isfinite().all()):
            raise FloatingPointError(f"a capture is not finite, with {choice}")

    def save(self) -> None:
        """Write and read a scene, a PSF bank and a checkpoint."""
        image, depth = self._scene()
        write_image(self.folder / "a.png", image, 16)
        write_depth(self.folder / "a.pfm", depth)
        read_rgbd(self.folder / "a.png", self.folder / "a.pfm")
        self.optics.psf_bank().save(self.folder / "bank.safetensors")
        PSFBank.load(self.folder / "bank.safetensors")
        write_state(self.folder / "state.safetensors", {"step": self.steps, "head": self.head.state_dict()})
        read_state(self.folder / "state.safetensors")

    def photograph(self) -> None:
        """Render a coded data set, and read it."""
        place = self.folder / "captures"
        render_scenes(self.optics, DeadLeaves(2, 32, 32, num_leaves=20), place)
        for capture in CodedCaptures(place):  # ty: ignore[not-iterable]
            assert capture["coded"].shape == (3, 32, 32)
        for path in sorted(place.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        place.rmdir()

    def command(self) -> None:
        """Run a subcommand in this process."""
        image, depth = dead_leaves(48, 48, num_leaves=20, seed=0)
        write_image(self.folder / "b.png", image)
        write_depth(self.folder / "b.pfm", depth)
        argv = ["simulate", str(self.folder / "b.png"), "--depth", str(self.folder / "b.pfm")]
        argv += ["-o", str(self.folder / "c.png"), "--masks", "1", "--fidelity", "draft"]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            if status := cli.main(argv):
                raise RuntimeError(f"simulate ended with status {status}")

    def refuse(self) -> None:
        """Read damaged files, which are refused: errors must not hold memory either."""
        data = (self.folder / "a.png").read_bytes()
        (self.folder / "damaged.png").write_bytes(data[: len(data) // 2])
        for read in (read_image, read_state):
            with contextlib.suppress(ValueError):
                read(self.folder / "damaged.png")

    def _scene(self) -> tuple[torch.Tensor, torch.Tensor]:
        height, width = (int(side) for side in self.generator.choice(SIDES, 2))
        image, depth = dead_leaves(height, width, num_leaves=40, seed=int(self.generator.integers(2**31)))
        return image, depth.clamp(0.2, 10)
