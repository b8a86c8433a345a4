"""Training of the network ``any-camera``: batches of crops of several cameras, their noise drawn anew in each step."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from kornia.color import CFA, linear_rgb_to_rgb, raw_to_rgb, rgb_to_linear_rgb
from torch import Tensor
from torch.nn import functional

from kornia_tidy import SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.data.photo_collages import grain
from kornia_tidy.files import write_bytes
from kornia_tidy.masks import MASK_SPAN, NoMask, PixelwiseMask
from kornia_tidy.optics import REFERENCE_WAVELENGTH
from kornia_tidy.reconstruction import RuledClosedForm
from kornia_tidy.reconstruction.any_camera import any_camera_head, beside_clipped, corrected, largest_share
from kornia_tidy.reconstruction.capture_checks import JPEG_NOISE
from kornia_tidy.reconstruction.clipped_light import CLIPPED
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.ruled_closed_form import IN_DIFFERENCES
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.average import MovingAverage
from kornia_tidy.training.noisy_crops import random_gain
from kornia_tidy.training.task_loss import psnr_ssim_loss
from tests.benchmarks.any_camera.cameras import camera, local_bank, own_system, pool_names
from tests.benchmarks.any_camera.captures import LEVELS, stored
from tests.benchmarks.shipped_files import in_eight_bits

CROP = 128  # px
CAMERAS_A_STEP, CROPS_A_CAMERA = 3, 2
ELECTRONS, BRIGHT = (200.0, 100_000.0), 0.6  # of white; exponent of a uniform place in their logarithm
READ_ELECTRONS = (1.0, 5.0)
NOISE_ERROR = 1.5  # largest factor by which the noise told is wrong
BITS = (8, 10, 12, 14, 16)
RATE, WARM_UP = 2e-4, 40
DECAY = 0.998
TAUGHT_SHARE = 0.35
SAVED_EVERY = 100  # steps


OVEREXPOSED = 0.2  # share of draws with up to four times the exposure at which white is full scale
DARK, DARKEST = 0.3, 0.1  # share of the other draws with less light, and the least share of it
MISTAKEN, MISTAKES = 0.25, 1  # share of draws with PSFs of a camera that is a little different; kinds of each camera
LENGTHS, SHIFT, FOCUS = 0.03, 0.02, 1.0  # errors: of lengths; of the mask, in radii of the pupil; of focus, in radians
DEMOSAICED = 0.1  # share of draws behind a Bayer filter
GRAINY = 0.2, 0.5  # share of draws, and of dark ones, whose scene has grain, which a network should keep
COMPRESSED, QUALITIES = 0.12, (85, 98)  # share of draws as JPEG; quality
LOSS_OF_HARM = 3.0  # of a picture that is worse than the closed form's, beside its loss: for each decibel behind
KINDS = {"-photographs": 0.4, "-more": 0.4, "-collages": 0.1, "": 0.1}  # share of draws of captures, where there are
PULL = 1e-4  # of the weights towards the first ones, for each step at the full rate
TEACHERS = ("edof-5", "edof-designed", "edof-flat")  # cameras with networks of their own that are better
TAUGHT = 0.7  # share of the own network's picture in the truth, behind such a camera whose capture is not disturbed


class Cameras:
    """The cameras of a pool: their captures, and their closed forms, made when they are first used."""

    def __init__(self, folder: Path, pool: str) -> None:
        self.folder, self.names = folder, pool_names(pool)
        self.forms: dict[tuple[str, int], RuledClosedForm] = {}
        self.teachers = {name: own_system(name).head.eval() for name in TEACHERS}

    def form(self, name: str, mistake: int = 0) -> RuledClosedForm:
        """Return the closed form of a camera, or of one that differs by small errors, numbered from 1."""
        if (name, mistake) not in self.forms:
            optics = camera(name)
            if mistake and optics.lens is None:
                optics = mistaken(optics, keyed_seed(name, mistake))
            form = RuledClosedForm(7)
            form.set_psfs(local_bank(optics, form.layers))
            self.forms[name, mistake] = form.requires_grad_(requires_grad=False)
        return self.forms[name, mistake]

    def crops(self, name: str, count: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return noise-free crops of captures and scenes in linear light."""
        kinds = [kind for kind in KINDS if (self.folder / f"{name}{kind}-light.npy").exists()]
        kind = kinds[int(torch.tensor([KINDS[kind] for kind in kinds]).multinomial(1, generator=random))]
        captures = stored(self.folder, name + kind)
        side, found = captures.light.shape[-1], []
        for _ in range(count):
            index = int(torch.randint(len(captures.light), (), generator=random))
            top, left = torch.randint(side - CROP + 1, (2,), generator=random).tolist()
            window = (index, slice(None), slice(top, top + CROP), slice(left, left + CROP))
            found.append([torch.from_numpy(part[window].astype(np.float32)) / LEVELS for part in captures])
        light, image = (torch.stack(part) for part in zip(*found, strict=True))
        return light, image


def mistaken(optics: TiDyOptics, seed: int) -> TiDyOptics:
    """Return a camera that differs by what a laboratory cannot hold: pitch, aperture, focus, mask place."""
    random = torch.Generator().manual_seed(seed)
    pitch, aperture, focus, down, across = (2 * torch.rand(5, generator=random, dtype=torch.float64) - 1).tolist()
    lens: Any = optics.camera
    f_number = lens.f_number * (1 + LENGTHS * aperture)
    radius = lens.focal_length / (2 * f_number)
    moved = 1 / float(lens.focus_distance) + FOCUS * focus * REFERENCE_WAVELENGTH / (math.pi * radius**2)
    other = ThinLensCamera(
        lens.focal_length,
        f_number=f_number,
        focus_distance=1 / max(moved, 1e-6),
        pixel_pitch=lens.pixel_pitch * (1 + LENGTHS * pitch),
        depth_range=lens.depth_range,
    )
    masks = optics.masks
    if not isinstance(masks, NoMask):
        masks = PixelwiseMask(initial=shifted(masks.heights(), SHIFT * down, SHIFT * across))
    return TiDyOptics(masks, other, fidelity=optics.fidelity, sensor=None).requires_grad_(requires_grad=False)


def shifted(heights: Tensor, down: float, across: float) -> Tensor:
    """Return heights (K, N, N) of masks that are moved by parts of the pupil's radius."""
    shift = 2 / MASK_SPAN * torch.tensor([across, down])  # a side is 2 wide here, and MASK_SPAN radii
    grid = functional.affine_grid(
        torch.cat([torch.eye(2), shift[:, None]], 1).expand(len(heights), 2, 3),
        [len(heights), 1, *heights.shape[-2:]],
        align_corners=False,
    ).to(heights)
    return functional.grid_sample(heights.detach()[:, None], grid, padding_mode="border", align_corners=False)[:, 0]


def drawn_sensor(random: torch.Generator) -> SensorNoise:
    """Return a random sensor."""
    place, read = torch.rand(2, generator=random, dtype=torch.float64).tolist()
    electrons = ELECTRONS[0] * (ELECTRONS[1] / ELECTRONS[0]) ** (place**BRIGHT)
    bits = BITS[int(torch.randint(len(BITS), (), generator=random))]
    read = READ_ELECTRONS[0] * (READ_ELECTRONS[1] / READ_ELECTRONS[0]) ** read
    return SensorNoise(read / electrons, full_well=electrons, bits=bits)


def with_grain(light: Tensor, image: Tensor, form: RuledClosedForm, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return captures and scenes with grain of the scene, blurred by the mean PSF in the captures."""
    rng = np.random.default_rng(int(torch.randint(2**31, (), generator=random)))
    drawn = torch.stack([torch.from_numpy(grain(*image.shape[-2:], rng)) for _ in image])
    grainy = rgb_to_linear_rgb((linear_rgb_to_rgb(image) + drawn).clamp(0, 1))
    blurred = convolve_kernels(grainy - image, form.psfs.mean(0)[None])[:, 0]
    return (light + blurred).clamp(0, 1), grainy


def compressed(light: Tensor, quality: int) -> Tensor:
    """Return a capture as JPEG keeps it."""
    pixels = (linear_rgb_to_rgb(light)[0].permute(1, 2, 0).flip(-1).numpy() * 255).round().astype(np.uint8)
    data = cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    read = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    return rgb_to_linear_rgb(torch.from_numpy(read).permute(2, 0, 1)[None].float() / 255)


def demosaiced(light: Tensor) -> Tensor:
    """Return pictures as behind a Bayer filter, interpolated linearly."""
    mosaic = torch.zeros_like(light[:, :1])
    for color, (row, column) in zip((0, 1, 1, 2), ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
        mosaic[:, 0, row::2, column::2] = light[:, color, row::2, column::2]
    return raw_to_rgb(mosaic, CFA.BG).clamp(0, 1)


@torch.no_grad()
def batch(cameras: Cameras, step: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the closed form's image, maps for the network, truth, where captures are not clipped, largest shares.

    They follow from the step alone.
    """
    random = torch.Generator().manual_seed(keyed_seed("any-camera seventh", step))
    torch.manual_seed(keyed_seed("any-camera seventh gains", step))
    parts = []
    for _ in range(CAMERAS_A_STEP):
        taught = float(torch.rand((), generator=random)) < TAUGHT_SHARE
        names = [name for name in cameras.names if (name in TEACHERS) == taught]
        name = names[int(torch.randint(len(names), (), generator=random))]
        light, image = cameras.crops(name, CROPS_A_CAMERA, random)
        chance = torch.rand(8, generator=random, dtype=torch.float64).tolist()
        gain = random_gain(torch.maximum(light.amax((0, 2, 3)), image.amax((0, 2, 3))))
        if chance[0] < OVEREXPOSED:
            gain = gain * 4 ** (chance[0] / OVEREXPOSED)
        elif chance[7] < DARK:
            gain = gain * DARKEST ** (chance[7] / DARK)
            light, image, gain = light * gain, image * gain, torch.ones_like(gain)  # grain of dark scenes is strong
        if chance[4] < GRAINY[chance[0] >= OVEREXPOSED and chance[7] < DARK]:
            light, image = with_grain(light, image, cameras.form(name), random)
        sensor = drawn_sensor(random)
        noisy = sensor(light * gain, generator=random)
        told = sensor.std(noisy) * NOISE_ERROR ** (2 * chance[1] - 1)
        if chance[2] < DEMOSAICED:
            noisy = demosaiced(noisy)
        if chance[5] < COMPRESSED:
            low, high = QUALITIES
            noisy = torch.cat([compressed(one[None], round(low + (high - low) * chance[6])) for one in noisy])
            told = torch.full_like(told, max(JPEG_NOISE, float(told.square().mean().sqrt())))
        form = cameras.form(name, 1 + int(chance[3] / MISTAKEN * MISTAKES) if chance[3] < MISTAKEN else 0)
        form.in_differences = 0.0 if chance[5] < COMPRESSED else IN_DIFFERENCES
        capture = linear_rgb_to_rgb(noisy)
        found = form.settings_of(capture, told)
        restored = form.restore_by(capture, found)
        largest = beside_clipped(largest_share(form, found), capture)
        truth = linear_rgb_to_rgb((image * gain).clamp(0, 1))
        known = (noisy < CLIPPED).all(1, keepdim=True)
        disturbed = chance[0] < OVEREXPOSED or chance[2] < DEMOSAICED or chance[5] < COMPRESSED or chance[3] < MISTAKEN
        if name in TEACHERS and not disturbed:
            with torch.autocast("cpu", torch.bfloat16):
                own = cameras.teachers[name](capture, noise=told).float().clamp(0, 1)
            errors = [(image - truth).square().mean((1, 2, 3), keepdim=True) for image in (own, restored.image)]
            truth = truth.lerp(own, TAUGHT * (errors[0] < errors[1]).to(own))
        parts.append((restored.image, restored.maps, truth, known, largest))
    whole = [torch.cat(part) for part in zip(*parts, strict=True)]
    turns, mirrored = int(torch.randint(4, (), generator=random)), bool(torch.randint(2, (), generator=random))
    turned = [part.rot90(turns, (2, 3)) for part in whole]
    return tuple(part.flip(3) if mirrored else part for part in turned)  # ty: ignore[invalid-return-type]


def losses(estimate: Tensor, truth: Tensor, known: Tensor) -> Tensor:
    """Return the loss of each picture, (B,)."""
    parts = zip(*(part.split(1) for part in (estimate, truth, known)), strict=True)
    return torch.stack([psnr_ssim_loss(*one) for one in parts])


def train(folder: Path, steps: int, minutes: float = math.inf) -> None:
    """Train; goes on from the checkpoint in the folder, and ends after so many steps or minutes."""
    cameras, path = Cameras(folder / "captures", "training"), folder / "checkpoint.pt"
    network = any_camera_head().network.train().to(memory_format=torch.channels_last)
    if (first := folder / "first.pt").exists():
        network.load_state_dict(torch.load(first, weights_only=True))
    anchor = [part.detach().clone() for part in network.parameters()]
    average = MovingAverage(network, DECAY)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, betas=(0.9, 0.99), weight_decay=0.0)
    step, log = 0, []
    if path.exists():
        state = torch.load(path, weights_only=True)
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        step, log = state["step"], state["log"]
    began = time.monotonic()
    began_at = step
    while step < steps and time.monotonic() - began < 60 * minutes:
        for group in optimizer.param_groups:
            falling = 0.5 * (1 + math.cos(math.pi * step / steps))
            group["lr"] = RATE * min(1, (step - began_at + 1) / WARM_UP) * (0.02 + 0.98 * falling)
        first, maps, truth, known, largest = batch(cameras, step)
        with torch.autocast("cpu", torch.bfloat16):
            found = network(maps.contiguous(memory_format=torch.channels_last)).float()
        estimate = corrected(first, found, largest)
        each, without = losses(estimate, truth, known), losses(first, truth, known)
        loss = (each + LOSS_OF_HARM * (each - without).clamp(min=0)).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        with torch.no_grad():
            for part, origin in zip(network.parameters(), anchor, strict=True):
                part.lerp_(origin, PULL * group["lr"] / RATE)
        average.update(network)
        step += 1
        log.append([float(each.detach().mean()), float(without.mean())])
        if step % SAVED_EVERY == 0 or step == steps:
            recent = np.mean(log[-SAVED_EVERY:], 0)
            seconds = time.monotonic() - began
            print(f"step {step}: loss {recent[0]:.3f}, closed form {recent[1]:.3f}, {seconds:.0f} s", flush=True)
            state = {"network": network, "average": average, "optimizer": optimizer}
            held = {name: part.state_dict() for name, part in state.items()} | {"step": step, "log": log}
            torch.save(held, path.with_suffix(".partial"))
            path.with_suffix(".partial").rename(path)
    record = {"step": step, "log": log}
    write_bytes(folder / "training.json", json.dumps(record).encode())


def ship(weights: Mapping[str, Tensor], path: Path) -> None:
    """Write weights of the network as the package holds them, in eight bits."""
    write_state(path, {"network": in_eight_bits(weights, list(weights))})
