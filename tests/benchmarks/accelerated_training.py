"""Trains networks of shipped systems, and masks, on a graphics processor on which all scenes stay.

``python -m tests.benchmarks.accelerated_training paint --root PHOTOGRAPHS --scenes SCENES``
``python -m tests.benchmarks.accelerated_training learn edof-designed edof-flat --scenes SCENES -o FOLDER``

``kornia-tidy train`` reads each sample from a file, and its kernels are launched one by one: one processor core feeds
a graphics processor no faster than itself. Here processes paint collages while others learn, which take them into the
accelerator's memory as they come. Noise is drawn for a batch at once, and a network's kernels are recorded and
replayed as CUDA graphs (:mod:`tests.benchmarks.accelerated_blocks`). Systems of one command learn in turn, one step
each, until a time is over: so two of them can be compared that learnt for as many steps from as many scenes.

FOLDER gets NAME.safetensors, a checkpoint, and NAME.json, settings and log. ``python -m
tests.benchmarks.accelerated_training unpack FOLDER/NAME`` makes of them what ``tests.benchmarks.ship_networks`` takes.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import multiprocessing
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn
from tqdm.auto import tqdm

from kornia_tidy.data import photo_collages
from kornia_tidy.data.photo_collages import photo_collage, photographs_in
from kornia_tidy.files import write_bytes
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction import closed_form
from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead, with_fine_maps
from kornia_tidy.reconstruction.metrics import SSIM_WINDOW, psnr
from kornia_tidy.reconstruction.pretrained import FOLDER
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.reconstruction.trained import build_head, describe, load_trained, update_psfs
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.sensor.exposure import electrons_at
from kornia_tidy.training.callbacks import BEST
from kornia_tidy.training.module import cosine_rate
from kornia_tidy.training.noisy_crops import GAIN, READ_ELECTRONS, SHOT_SHARE, TINT, electrons_of
from kornia_tidy.training.settings import TrainingSettings
from kornia_tidy.training.task_loss import LEAST_MSE, SSIM_WEIGHT, psnr_ssim_loss

SIZE = 256  # side of a scene in pixels
CHUNK = 32  # scenes in a file
LEVELS = 2**16 - 1
HELD_OUT = "held-out.npy"
LOOK_EVERY, LOOK_AT_MOST = 20, 4  # turns between looks for new files, and files taken in a look
REPORT_EVERY = 100  # steps
SAVE_EVERY = 60.0  # seconds, or twenty times as long as it takes
TRIED, SLOWEST = 40, 0.5  # turns after which masks stay if a turn takes more seconds
SSIM_DEVIATION, SSIM_CONSTANTS = 1.5, (1e-4, 9e-4)  # of the window in pixels; Wang et al., IEEE TIP 2004
LOSS_TOLERANCE = 2e-3  # dB
BETAS = (0.99, 0.999)  # of the masks, as in the paper
CHECKED = 0.99  # least cosine between gradients by plain and by fast kernels, in bfloat16


class Recipe(NamedTuple):
    """What a system learns from, and how."""

    noise_range: tuple[float, float]
    electrons: tuple[float, float]
    noise_error: float
    validation: tuple[float, ...]
    """Noise of full scale; above 1 electrons of white at the reference f-number."""
    mask_share: float = 0.0
    """Share of the time in which masks learn, too, at first."""
    every: int = 1
    """It takes a step in every turn of so many."""


RECIPES = {
    "edof-5": Recipe((0.002, 0.045), (500.0, 20e3), 2.0, (0.002, 0.01, 0.03), every=3),
    "edof-designed": Recipe((0.001, 0.01), (500.0, 57e3), 1.0, (57e3, 10e3, 2e3, 500.0), mask_share=0.45),
    "edof-flat": Recipe((0.001, 0.01), (500.0, 57e3), 1.0, (57e3, 10e3, 2e3, 500.0)),
}


# ---------------------------------------------------------------------- scenes


def paint(root: Path, folder: Path, count: int, processes: int, seed: int, contrast: tuple[float, float]) -> None:
    """Paint the scenes that are held out, then ``count`` others, into files of 32 each."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(root, folder, seed, contrast, number) for number in range(-1, math.ceil(count / CHUNK))]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for _ in tqdm(pool.imap_unordered(_paint_chunk, jobs), total=len(jobs), disable=None, unit="file"):
            pass


def _paint_chunk(job: tuple[Path, Path, int, tuple[float, float], int]) -> None:
    """Paint one file: image and nearness of each scene, (CHUNK, 4, SIZE, SIZE) uint16."""
    root, folder, seed, contrast, number = job
    vars(photo_collages)["CONTRAST"] = contrast
    torch.set_num_threads(1)
    photographs = photographs_in(root)
    planes = np.empty((CHUNK, 4, SIZE, SIZE), np.uint16)
    for place in range(CHUNK):
        drawn = keyed_seed(seed, "held out" if number < 0 else "scene", number * CHUNK + place)
        image, depth = photo_collage(photographs, SIZE, SIZE, depth_range=(1.0, math.inf), seed=drawn)
        planes[place] = (torch.cat([image, 1 / depth]) * LEVELS).round().numpy().astype(np.uint16)
    path = folder / (HELD_OUT if number < 0 else f"{number:06d}.npy")
    temporary = path.with_suffix(".part")
    with temporary.open("wb") as file:
        np.save(file, planes)
    temporary.rename(path)


class Scenes:
    """Scenes on a device.

    Args:
        folder: of :func:`paint`.
        device: where the scenes are kept.
    """

    def __init__(self, folder: Path, device: torch.device) -> None:
        self.folder, self.device = folder, device
        self.seen: set[str] = set()
        self.parts: list[tuple[Tensor, Tensor]] = []

    def __len__(self) -> int:
        """Return the number of scenes."""
        return CHUNK * len(self.parts)

    def look(self, at_most: int = LOOK_AT_MOST) -> None:
        """Take files that are new."""
        new = [path for path in sorted(self.folder.glob("[0-9]*.npy")) if path.name not in self.seen]
        for path in new[:at_most]:
            self.seen.add(path.name)
            self.parts.append(self.read(path.name))

    def read(self, name: str) -> tuple[Tensor, Tensor]:
        """Return images, encoded, and nearness of the scenes in a file."""
        planes = torch.from_numpy(np.load(self.folder / name).view(np.int16)).to(self.device)
        planes = (planes.int() & LEVELS).float() / LEVELS
        return planes[:, :3].half(), planes[:, 3:].half()

    def places(self, batch: int) -> list[tuple[int, int]]:
        """Return places of scenes at random."""
        return [divmod(number, CHUNK) for number in torch.randint(len(self), (batch,)).tolist()]


def linear(images: Tensor) -> Tensor:
    """Return linear light, float32, of images in sRGB."""
    images = images.float()
    return torch.where(images > 0.04045, ((images + 0.055) / 1.055) ** 2.4, images / 12.92)


def encoded(light: Tensor) -> Tensor:
    """Return sRGB of linear light, which is limited to [0, 1]."""
    light = light.clamp(0, 1)
    bright = light.clamp(min=0.0031308)
    return torch.where(light > 0.0031308, 1.055 * bright ** (1 / 2.4) - 0.055, 12.92 * light)


# ---------------------------------------------------------------------- noise


class Sensors(NamedTuple):
    """Sensors of a batch, one for each capture: read noise, and electrons at full scale."""

    sigma: Tensor
    """(B, 1, 1, 1), of full scale."""
    full_well: Tensor
    """(B, 1, 1, 1); infinite where there is no shot noise."""

    def __call__(self, light: Tensor) -> Tensor:
        """Return noisy captures. The gradient is that of the mean."""
        with_shot = self.full_well.isfinite()
        well = self.full_well.where(with_shot, 1.0)
        counted = torch.poisson((light.detach().clamp(min=0) * well).clamp(max=1e6))
        noise = torch.where(with_shot, (counted.minimum(well) / well) - light.detach(), 0.0)
        return (light + noise + self.sigma * torch.randn_like(light)).clamp(0, 1)

    def std(self, light: Tensor) -> Tensor:
        """Return the standard deviation of the noise in each pixel."""
        return (self.sigma.square() + light.clamp(min=0) / self.full_well).sqrt()


def drawn_sensors(
    batch: int, noise: tuple[float, float], electrons: tuple[float, float], device: torch.device
) -> Sensors:
    """Return sensors at random, as :func:`kornia_tidy.training.noisy_crops.random_sensor` draws one."""
    with_shot, place = torch.rand(2, batch, 1, 1, 1, device=device)
    with_shot = with_shot < SHOT_SHARE
    level, well = (least * (largest / least) ** place for least, largest in (noise, electrons))
    return Sensors(torch.where(with_shot, READ_ELECTRONS / well, level), well.where(with_shot, math.inf))


def with_gain(light: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return capture and truth with gains at random, as :func:`kornia_tidy.training.noisy_crops.random_gain` draws."""
    peak = torch.maximum(light.detach().amax((2, 3)), truth.amax((2, 3)))
    least, largest = (math.log(end) for end in GAIN)
    exposure = least + (largest - least) * torch.rand(len(light), 1, device=light.device)
    gain = (exposure + TINT * torch.randn_like(peak)).exp().minimum(1 / peak.clamp(min=1e-6))[..., None, None]
    return light * gain, truth * gain


# ---------------------------------------------------------------------- learning


class Run:
    """A system that learns.

    Args:
        name: of the system.
        scenes: to learn from.
        args: of the command.
    """

    def __init__(self, name: str, scenes: Scenes, args: argparse.Namespace) -> None:
        self.name, self.scenes, self.args, self.recipe = name, scenes, args, RECIPES[name]
        if args.noise_range is not None:
            self.recipe = self.recipe._replace(noise_range=tuple(args.noise_range))
        if args.electrons is not None:
            self.recipe = self.recipe._replace(electrons=tuple(args.electrons))
        self.device = scenes.device
        system = load_trained(args.begin / f"{name}.safetensors")
        if args.fine and not system.settings.fine:
            system = _with_fine_maps(system)
        if args.mask_share is not None and self.recipe.mask_share:
            self.recipe = self.recipe._replace(mask_share=args.mask_share)
        self.settings = _settings(system, self.recipe, args)
        self.optics, self.head = system.optics.to(self.device), system.head.to(self.device)
        self.kept = self.optics.sensor, self.optics.color_space
        self.optics.sensor, self.optics.color_space = None, "linear"
        self.optics.compositing = args.compositing
        self.optics.requires_grad_(requires_grad=False)
        self.head.requires_grad_().to(memory_format=torch.channels_last)  # ty: ignore[no-matching-overload]
        self.average = copy.deepcopy(self.head).requires_grad_(requires_grad=False).eval()
        self.head.train()
        self.moving = self.recipe.mask_share > 0 and args.masks
        self.steps, self.light = 0, list[Tensor]()
        self.log: dict[str, list[dict[str, float]]] = {"training": [], "validation": []}
        camera = self.settings.camera()
        self.electrons = electrons_of(camera.f_number, self.settings.electrons, self.settings.reference_f_number)
        self.loss: Any = PsnrSsim(self.device)
        self.since, self.since_step = time.perf_counter(), 0

    def prepare(self) -> None:
        """Make the network fast, and its optimisers."""
        network: Any = self.head.network
        network.range_checked = True
        self.plain = copy.deepcopy(network)
        if self.device.type == "cuda":
            shape = (self.args.batch, network.in_channels, SIZE, SIZE)
            maps = torch.rand(shape, device=self.device).contiguous(memory_format=torch.channels_last)
            if self.args.fast:
                _use_checked_blocks(network, maps, self.name)
            maps.requires_grad_(self.moving)
            with torch.autocast("cuda", torch.bfloat16, cache_enabled=False):
                torch.cuda.make_graphed_callables(network, (maps,), num_warmup_iters=3)
            images = torch.rand(self.args.batch, 3, SIZE, SIZE, device=self.device)
            torch.backends.cudnn.allow_tf32 = False  # of the loss
            self.loss = torch.cuda.make_graphed_callables(
                self.loss, (images.clone().requires_grad_(), images.clone()), num_warmup_iters=3
            )
            network.forward = _LaidOut(network.forward, wants_gradient=self.moving)
        self.adam = torch.optim.AdamW(self.head.parameters(), lr=self.args.lr, fused=self.device.type == "cuda")
        self.masks = None
        if self.moving:
            self.optics.masks.requires_grad_()
            group = self.optics.parameter_groups(self.args.lr_metres, self.args.lr)[0]
            self.masks = torch.optim.Adam([{**group, "highest": group["lr"]}], betas=BETAS)
        self.pairs = list(self.average.parameters()), list(self.head.parameters())
        self.take_captures()

    def check(self) -> None:
        """Use plain kernels from now on if recorded ones do not follow the weights, by result and gradients.

        When this program first ran, two of three networks diverged within 100 steps on the card, where on a processor
        they do not; it was not found why.
        """
        if self.device.type != "cuda":
            return
        network: Any = self.head.network
        shape = (self.args.batch, network.in_channels, SIZE, SIZE)
        before = [value.detach().clone() for value in network.parameters()]
        for turn in range(3):
            maps = torch.rand(shape, device=self.device)
            wanted = torch.rand(self.args.batch, 3, SIZE, SIZE, device=self.device)
            with torch.no_grad():
                for own, value in zip(network.parameters(), before, strict=True):
                    own.copy_(value * (1 + 0.02 * turn * torch.randn_like(value)))
            self.plain.load_state_dict(network.state_dict())
            found = [self._gradients(one, loss, maps, wanted) for one, loss in (
                (network, self.loss), (self.plain, PsnrSsim(self.device)))]  # fmt: skip
            cosine = float(torch.cosine_similarity(*found, dim=0))
            print(f"{self.name}: cosine of gradients, recorded and plain, {cosine:.5f}", flush=True)
            if not cosine > CHECKED:
                for module in network.modules():
                    vars(module).pop("forward", None)
                self.loss = PsnrSsim(self.device)
                break
        with torch.no_grad():
            for own, value in zip(network.parameters(), before, strict=True):
                own.copy_(value)

    @staticmethod
    def _gradients(network: Any, loss: Any, maps: Tensor, wanted: Tensor) -> Tensor:
        """Return the normalised gradients of all weights in one vector."""
        with torch.autocast("cuda", torch.bfloat16, cache_enabled=False):
            out = network(maps)
        loss((wanted + out.float()).contiguous(), wanted).backward()
        found = [value.grad.detach().float().flatten().clone() for value in network.parameters()]
        for value in network.parameters():
            value.grad = None
        return torch.cat([part / part.norm().clamp(min=1e-30) for part in found])

    # ------------------------------------------------------------------ captures

    def capture(self, images: Tensor, nearness: Tensor) -> Tensor:
        """Return captures of a few scenes without noise, in linear light."""
        camera = self.optics.camera
        assert isinstance(camera, ThinLensCamera)
        return self.optics(linear(images), metres(camera, nearness.float()))

    @torch.no_grad()
    def captured(self, images: Tensor, nearness: Tensor) -> Tensor:
        """Return captures of the scenes of a file."""
        parts = zip(images.split(CHUNK // 2), nearness.split(CHUNK // 2), strict=True)
        return torch.cat([self.capture(*part) for part in parts])

    def take_captures(self) -> None:
        """Take captures of new scenes, unless masks move."""
        if not self.moving:
            self.light += [self.captured(*part) for part in self.scenes.parts[len(self.light) :]]

    def stop_masks(self) -> None:
        """Leave the masks as they are from now on."""
        if not self.moving:
            return
        self.moving = False
        print(f"{self.name}: masks stay after {self.steps} steps", flush=True)
        self.optics.requires_grad_(requires_grad=False)
        self.masks = None
        with torch.no_grad():
            update_psfs(self.head, self.optics)
            update_psfs(self.average, self.optics)
        self.take_captures()

    # ------------------------------------------------------------------ steps

    def step(self, progress: float) -> None:
        """Take a step, after a fraction of the time."""
        if self.moving and progress >= self.recipe.mask_share:
            self.stop_masks()
        loss = self.forward()
        loss.backward()
        for group in self.adam.param_groups:
            group["lr"] = self.args.lr * cosine_rate(progress)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        if self.masks is not None:
            for group in self.masks.param_groups:
                group["lr"] = group["highest"] * cosine_rate(progress / self.recipe.mask_share)
            self.masks.step()
            self.masks.zero_grad(set_to_none=True)
        get_ema_multi_avg_fn(min(self.args.ema, (10 + self.steps) / (20 + self.steps)))(*self.pairs, self.steps)
        self.steps += 1
        if self.steps == 1 or self.steps % REPORT_EVERY == 0:
            self.report(float(loss.detach()), progress)

    def forward(self) -> Tensor:
        """Return the loss of a batch."""
        places = self.scenes.places(self.args.batch)
        images, nearness = (torch.stack([self.scenes.parts[one][k][two] for one, two in places]) for k in (0, 1))
        truth = linear(images)
        if self.moving:
            light = self.capture(images, nearness)
            update_psfs(self.head, self.optics)
        else:
            light = torch.stack([self.light[one][two] for one, two in places])
        light, truth = with_gain(light, truth)
        sensors = drawn_sensors(len(light), self.settings.noise_range, self.electrons, self.device)
        coded = sensors(light)
        with torch.no_grad():
            error = self.settings.noise_error ** (2 * torch.rand(len(light), 1, 1, 1, device=self.device) - 1)
            told, wanted = sensors.std(coded) * error, encoded(truth)
        with torch.autocast(self.device.type, torch.bfloat16, cache_enabled=False):
            estimate = self.head(encoded(coded), noise=told)
        return self.loss(estimate.float().contiguous(), wanted.contiguous())

    # ------------------------------------------------------------------ records

    def report(self, loss: float, progress: float) -> None:
        """Note loss and speed."""
        now = time.perf_counter()
        seconds = (now - self.since) / max(1, self.steps - self.since_step)
        self.since, self.since_step = now, self.steps
        row = {"epoch": 0, "step": self.steps, "loss": round(loss, 4), "seconds_a_step": round(seconds, 5)}
        self.log["training"].append(row)
        print(self.name, row, f"{progress:.2f} of the time, {len(self.scenes)} scenes", flush=True)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return the mean PSNR of the averaged network over the held-out scenes, with the same noise each time."""
        images, nearness = self.scenes.read(HELD_OUT)
        light, truth = self.captured(images, nearness), encoded(linear(images))
        scores = {}
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            for level in self.recipe.validation:
                torch.manual_seed(1)
                sensors = self.sensors(level)
                coded = sensors(light)
                parts = zip(encoded(coded).split(8), sensors.std(coded).split(8), strict=True)
                with torch.autocast(self.device.type, torch.bfloat16, cache_enabled=False):
                    estimate = torch.cat([self.average(one, noise=two).float() for one, two in parts])
                name = f"val_psnr_{level:g}" + "e" * (level > 1)
                scores[name] = round(float(psnr(estimate.clamp(0, 1), truth).mean()), 4)
        return scores

    def sensors(self, level: float) -> Sensors:
        """Return sensors of a noise of full scale or, above 1, of electrons at the reference f-number."""
        one = torch.ones(1, 1, 1, 1, device=self.device)
        if level < 1:
            return Sensors(level * one, math.inf * one)
        here = electrons_at(self.settings.camera().f_number, level, self.settings.reference_f_number)
        return Sensors(READ_ELECTRONS / here * one, here * one)

    def save(self) -> None:
        """Validate, and write a checkpoint with the averaged network, and the log. What is not finite is not kept."""
        with torch.no_grad():
            update_psfs(self.average, self.optics)
        scores = self.validate()
        print(self.name, self.steps, scores, flush=True)
        if not all(math.isfinite(value) for value in scores.values()):
            return
        self.log["validation"].append({"epoch": 0, "step": self.steps, **scores})
        self.optics.sensor, self.optics.color_space = self.kept
        weights = {f"optics.{name}": value for name, value in self.optics.state_dict().items()}
        weights |= {f"average.network.{name}": value for name, value in self.average.state_dict().items()}
        state = {
            "state_dict": {name: value.detach().cpu().contiguous() for name, value in weights.items()},
            "settings": self.settings.as_dict(),
            "task": self.settings.task,
            "description": describe(self.optics, self.average),
            "global_step": self.steps,
        }
        self.optics.sensor, self.optics.color_space = None, "linear"
        write_state(self.args.output / f"{self.name}.safetensors", state)
        write_bytes(self.args.output / f"{self.name}.json", json.dumps(self.log).encode())


class _LaidOut:
    """A network's forward method for recorded graphs, which always take the same kind of input."""

    def __init__(self, forward: Any, *, wants_gradient: bool) -> None:
        self.forward, self.wants_gradient = forward, wants_gradient

    def __call__(self, maps: Tensor) -> Tensor:
        maps = maps.contiguous(memory_format=torch.channels_last)
        return self.forward(maps.requires_grad_() if self.wants_gradient and not maps.requires_grad else maps)


class PsnrSsim:
    """The loss :func:`kornia_tidy.training.task_loss.psnr_ssim_loss` without waits, which a graph cannot record."""

    def __init__(self, device: torch.device) -> None:
        places = torch.arange(SSIM_WINDOW, device=device, dtype=torch.float32) - SSIM_WINDOW // 2
        window = (-0.5 * (places / SSIM_DEVIATION) ** 2).exp()
        self.window = window / window.sum()
        self.matrices: dict[int, Tensor] = {}
        one, two = torch.rand(2, 2, 3, 32, 40, device=device)
        off = abs(float(self(one, two) - psnr_ssim_loss(one, two)))
        if off > LOSS_TOLERANCE:
            raise RuntimeError(f"the loss differs from psnr_ssim_loss by {off}")

    def __call__(self, estimate: Tensor, wanted: Tensor) -> Tensor:
        """Return the loss of images, (B, 3, H, W)."""
        squared = (estimate - wanted).square().mean((1, 2, 3))
        maps = torch.stack([estimate, wanted, estimate * estimate, wanted * wanted, estimate * wanted])
        maps = self.sums(maps.shape[-2]) @ maps @ self.sums(maps.shape[-1]).T
        one, two, one_one, two_two, one_two = maps.unbind(0)
        first, second = SSIM_CONSTANTS
        light = (2 * one * two + first) / (one * one + two * two + first)
        shape = (2 * (one_two - one * two) + second) / (one_one - one * one + two_two - two * two + second)
        similarity = (light * shape).flatten(1).mean(1)
        return (10 * (squared + LEAST_MSE).log10() + SSIM_WEIGHT * (1 - similarity)).mean()

    def sums(self, side: int) -> Tensor:
        """Return the matrix (N, side) of weighted sums over all N windows along a side; it is made once.

        A processor takes 70 ms for the loss of two images of 256 pixels so, and 750 by convolutions.
        """
        if side not in self.matrices:
            along = torch.arange(side, device=self.window.device)
            place = along - torch.arange(side - SSIM_WINDOW + 1, device=self.window.device)[:, None]
            inside = (place >= 0) & (place < SSIM_WINDOW)
            self.matrices[side] = self.window[place.clamp(0, SSIM_WINDOW - 1)] * inside
        return self.matrices[side]


def _use_checked_blocks(network: Any, maps: Tensor, name: str) -> None:
    """Use fast blocks in a network if they give its result and gradients, else fewer of them or none."""
    slope = torch.randn(len(maps), network.out_channels, SIZE, SIZE, device=maps.device)

    def gradients(of: Any) -> Tensor:
        with torch.autocast("cuda", torch.bfloat16, cache_enabled=False):
            out = of(maps)
        found = torch.autograd.grad(out.float(), list(of.parameters()), slope)
        return torch.cat([out.float().flatten(), *(part.float().flatten() / part.norm() for part in found)])

    from tests.benchmarks.accelerated_blocks import use_fast_blocks

    wanted = gradients(copy.deepcopy(network))
    for linear_too in (True, False):
        tried = copy.deepcopy(network)
        try:
            use_fast_blocks(tried, linear=linear_too)
            cosine = float(torch.cosine_similarity(gradients(tried), wanted, dim=0))
            torch.cuda.synchronize()
            started = time.perf_counter()
            for _ in range(3):
                gradients(tried)
            torch.cuda.synchronize()
            print(f"{name}: fast blocks {linear_too}, cosine {cosine:.5f}, {(time.perf_counter() - started) / 3:.4f} s")
        except Exception as error:
            print(f"{name}: fast blocks {linear_too} failed: {error!r}"[:1000], flush=True)
            continue
        if cosine > CHECKED:
            use_fast_blocks(network, linear=linear_too)
            return


def _with_fine_maps(system: Any) -> Any:
    """Return a system whose network takes the finer maps of the closed form, too, and makes the same of a capture."""
    settings = system.settings.replace(fine=True)
    head = build_head(settings)
    assert isinstance(head, ClosedFormHead)
    head.load_state_dict(with_fine_maps(system.head.state_dict(), head))
    return system._replace(head=head.eval(), settings=settings)


def _settings(system: Any, recipe: Recipe, args: argparse.Namespace) -> TrainingSettings:
    """Return the settings of a run: those of the shipped system with what this run changes."""
    changed = {
        "learn": "both" if recipe.mask_share and args.masks else "network", "seed": args.seed, "batch": args.batch,
        "lr": args.lr, "lr_metres": args.lr_metres, "ema": args.ema, "scenes": args.count, "epochs": 1, "size": SIZE,
        "root": None, "noise_range": recipe.noise_range, "electrons": recipe.electrons, "data": "photo-collages",
        "noise_error": recipe.noise_error, "precision": "bf16-mixed", "channels_last": True, "validation_scenes": CHUNK,
        "compositing": args.compositing,
    }  # fmt: skip
    return TrainingSettings.of(system).replace(**changed)


def learn(args: argparse.Namespace) -> None:
    """Let systems learn in turn until the time is over."""
    device = torch.device(args.device)
    torch.manual_seed(args.seed)
    args.output.mkdir(parents=True, exist_ok=True)
    scenes = Scenes(args.scenes, device)
    runs = [Run(name, scenes, args) for name in args.systems]
    _say(args, "loaded")
    if device.type == "cuda" and args.fast:
        _use_fast_bilateral()
    _make_ready(runs, scenes, args)
    seconds = args.seconds or (math.inf if args.steps else 500.0)
    begun, end = time.time(), args.from_time + seconds
    saved, took, turn = time.time(), 0.0, 0
    while (now := time.time()) < end and not 0 < args.steps <= turn:
        progress = turn / args.steps if args.steps else (now - begun) / (end - begun)
        if turn % LOOK_EVERY == 0:
            _look(runs, scenes)
        for run in list(runs):
            if turn % run.recipe.every == 0 and not _stepped(run, progress):
                runs.remove(run)
        turn += 1
        if turn == TRIED and not args.steps and now - begun > TRIED * SLOWEST:
            for run in runs:
                run.stop_masks()
        if now - saved > max(SAVE_EVERY, 20 * took):
            for run in runs:
                run.save()
            saved = time.time()
            took = saved - now
    for run in runs:
        run.save()
    _say(args, f"done, {turn} turns in {time.time() - begun:.0f} s")


def _make_ready(runs: Sequence[Run], scenes: Scenes, args: argparse.Namespace) -> None:
    """Record the kernels of all runs, check them, and wait for the first scenes."""
    for run in runs:
        run.prepare()
    for run in runs:  # when all are recorded
        run.check()
        _say(args, f"{run.name} ready")
    while len(scenes) < CHUNK * args.first or not (args.scenes / HELD_OUT).exists():
        scenes.look()
        time.sleep(0.1)
    _say(args, f"{len(scenes)} scenes")
    for run in runs:
        run.take_captures()
        run.save()


def _look(runs: Sequence[Run], scenes: Scenes) -> None:
    """Take new scenes and their captures."""
    scenes.look()
    for run in runs:
        run.take_captures()


def _say(args: argparse.Namespace, words: str) -> None:
    print(f"{time.time() - args.from_time:.0f} s: {words}", flush=True)


def _stepped(run: Run, progress: float) -> bool:
    """Take a step of a run, without its masks from now on if that fails; return whether it goes on."""
    try:
        run.step(progress)
    except Exception:
        traceback.print_exc()
        if not run.moving:
            return False
        run.stop_masks()
    return True


def _use_fast_bilateral() -> None:
    """Let closed forms smooth by one kernel where no gradients are wanted."""
    from tests.benchmarks.accelerated_blocks import bilateral

    plain = closed_form.bilateral_filter
    image, color = torch.rand(2, 3, 40, 50, device="cuda"), torch.full((2, 1, 40, 50), 0.2, device="cuda")
    try:
        off = float((bilateral(image, color, 7, 2.0) - plain(image, color, 7, 2.0)).abs().max())
    except Exception as error:
        print(f"fast bilateral filter failed: {error!r}"[:1000], flush=True)
        return
    print(f"fast bilateral filter differs by {off:.1e}", flush=True)

    def either(image: Tensor, color: Tensor | float, window: int = 7, space: float = 2.0) -> Tensor:
        if image.requires_grad or not isinstance(color, Tensor) or image.dtype != torch.float32:
            return plain(image, color, window, space)
        return bilateral(image, color, window, space)

    if off < 1e-5:
        vars(closed_form)["bilateral_filter"] = either


def unpack(path: Path) -> None:
    """Make the folder of a run, PATH, from PATH.safetensors and PATH.json."""
    path.mkdir(exist_ok=True)
    for name, rows in json.loads(path.with_suffix(".json").read_text()).items():
        lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
        write_bytes(path / f"{name}.csv", ("\n".join(lines) + "\n").encode())
    write_bytes(path / BEST, path.with_suffix(".safetensors").read_bytes())
    TrainingSettings.of(load_trained(path / BEST)).write(path / "settings.json")


def main() -> None:
    """Run one of the three commands."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.accelerated_training", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    painter = commands.add_parser("paint", help="paint collages of photographs")
    painter.add_argument("--root", type=Path, required=True, metavar="FOLDER", help="of photographs")
    painter.add_argument("--processes", type=int, default=multiprocessing.cpu_count(), metavar="N")
    painter.add_argument(
        "--contrast",
        type=float,
        nargs=2,
        default=photo_collages.CONTRAST,
        metavar=("LEAST", "LARGEST"),
        help="of textures, of that in the photographs",
    )
    learner = commands.add_parser("learn", help="train systems")
    learner.add_argument("systems", nargs="+", choices=RECIPES, metavar="NAME", help=f"of {', '.join(RECIPES)}")
    learner.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    learner.add_argument("--begin", type=Path, default=FOLDER, help="folder of the systems before (default: shipped)")
    learner.add_argument(
        "--seconds", type=float, help="for all, from --from-time (default: 500, with --steps no limit)"
    )
    learner.add_argument("--steps", type=int, default=0, help="turns in place of a time, as on a processor")
    learner.add_argument(
        "--mask-share", type=float, help="of the time or steps, in which masks move (default: its own)"
    )
    learner.add_argument(
        "--fine", action="store_true", help="give networks a second deconvolution for each depth, a finer one"
    )
    learner.add_argument("--from-time", type=float, default=time.time(), help="seconds since 1970 (default: now)")
    learner.add_argument("--batch", type=int, default=8)
    learner.add_argument("--lr", type=float, default=1e-3)
    learner.add_argument("--lr-metres", type=float, default=4e-9)
    learner.add_argument("--masks", action=argparse.BooleanOptionalAction, default=True, help="let masks learn, too")
    learner.add_argument("--compositing", choices=("gather", "occlusion"), default="gather", help="of the captures")
    learner.add_argument("--noise-range", type=float, nargs=2, metavar=("LEAST", "LARGEST"), help="(default: its own)")
    learner.add_argument("--electrons", type=float, nargs=2, metavar=("LEAST", "LARGEST"), help="(default: its own)")
    learner.add_argument("--ema", type=float, default=0.999)
    learner.add_argument("--first", type=int, default=4, help="files of scenes to wait for")
    learner.add_argument("--device", default="cuda:0")
    learner.add_argument("--fast", action=argparse.BooleanOptionalAction, default=True, help="use Triton's kernels")
    for command in (painter, learner):
        command.add_argument("--scenes", type=Path, required=True, metavar="FOLDER")
        command.add_argument("--count", type=int, default=20000, help="of scenes")
        command.add_argument("--seed", type=int, default=151)
    unpacker = commands.add_parser("unpack", help="make the folder of a run")
    unpacker.add_argument("path", type=Path)
    args = parser.parse_args()
    if args.command == "paint":
        paint(args.root, args.scenes, args.count, args.processes, args.seed, tuple(args.contrast))
    elif args.command == "learn":
        learn(args)
    else:
        unpack(args.path)


if __name__ == "__main__":
    main()
