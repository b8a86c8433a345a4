"""Histories: what a camera did before a capture and the way the capture is taken, neither of which may change it.

``python -m tests.camera.histories --count 2000 --seed 0`` draws histories and counts those that changed a capture. One
is a camera, a scene, some events in the life of the camera, and a way to take the last capture. It is compared with the
capture of a new camera that is made alike and has done nothing: to the last bit, or to rounding where the way computes
sums in another order.
"""

from __future__ import annotations

import argparse
import copy
import math
import pickle
import random
import sys
import tempfile
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from kornia_tidy import Fidelity, FresnelLens, NoMask, PixelwiseMask, SensorNoise, TiDyOptics, burst, moving_capture
from kornia_tidy.camera import camera_of_state
from kornia_tidy.masks import MASK_SPAN, CubicMask, FourierMask, RadialMask, SpiralMask, ZernikeMask
from kornia_tidy.modulator import DiffractionEfficiency, DwellTimes, LearnableDwellTimes, Switching
from kornia_tidy.optics import DefocusRange, Lens, Spectrum, ThinLensCamera, annular_aperture, camera_spectrum
from kornia_tidy.sensor import draw_pattern

T = TypeVar("T")

COMPOSITINGS = ("gather", "scatter", "occlusion")
BORDERS = ("reflect", "replicate", "zero", "circular", "valid")
LENSES = ("default", "range", "ring", "wide", "wide ring", "real")
CORNER = (400.0, 500.0)  # px from the axis of a real lens
MASKS = ("pixelwise", "zernike", "radial", "spiral", "fourier", "cubic", "fresnel", "none")
MODULATORS = ("equal", "unequal", "learnt", "switching", "efficiency")
SPECTRA = ("rgb", "monochrome", "binned", "reflectance")
SENSORS = ("none", "noise", "bits", "pattern")
NOISE = ("params", "generator")
EXPOSURES = ("capture", "burst", "motion")
SENSOR_SIDE = 192  # pixels of the fixed pattern; pictures are smaller
SIDE = 7  # of pixelwise masks
# Rounding of a capture in linear light, full scale 1, when its sums are made in another order: transforms of some
# thousand values in [0, 1] with unit round-off 6e-8 (1.1e-16); see also `loosened`.
ROUNDING = {torch.float32: 4e-6, torch.float64: 1e-12}
# PSFs are computed in float64 for several depths by one product of matrices: the last bits follow from which these are.
_LAST_BITS = {torch.float32: 0.0, torch.float64: 1e-15}


class Choose(Protocol):
    """Draws one of several values: hypothesis, or a random generator."""

    def __call__(self, values: Sequence[T], /) -> T: ...


@dataclass(frozen=True)
class Camera:
    """How to make a camera; the same each time.

    Args:
        lens: one of :data:`LENSES`.
        masks: one of :data:`MASKS`.
        modulator: one of :data:`MODULATORS`.
        spectrum: one of :data:`SPECTRA`.
        sensor: one of :data:`SENSORS`.
        fidelity: settings.
        compositing: one of :data:`COMPOSITINGS`.
        border: one of :data:`BORDERS`.
        color_space: ``"linear"``, ``"srgb"`` or ``"paper"``.
        seed: of masks and fixed pattern.
    """

    lens: str
    masks: str
    modulator: str
    spectrum: str
    sensor: str
    fidelity: Fidelity
    compositing: str
    border: str
    color_space: str
    seed: int

    def make(self, seed: int | None = None) -> TiDyOptics:
        """Return a new camera; with another seed, one with other masks."""
        generator = torch.Generator().manual_seed(self.seed if seed is None else seed)
        masks = _masks(self.masks, generator)
        aperture = None
        if self.lens.endswith("ring"):
            side = masks.phase.shape[-1]
            aperture = annular_aperture(side, MASK_SPAN / side, 0.5)
        return TiDyOptics(
            masks, _lens(self.lens), _modulator(self.modulator, len(masks.phase)), _sensor(self.sensor, self.seed),
            self.fidelity, self.compositing, self.color_space, self.border, _spectrum(self.spectrum), aperture,
            lens=copy.deepcopy(_real_lens()) if self.lens == "real" else None, field_center=CORNER,
        )  # fmt: skip


def _masks(name: str, generator: torch.Generator) -> Any:
    if name in {"pixelwise", "published"}:
        return PixelwiseMask(2, SIDE if name == "pixelwise" else 23, generator=generator)
    families = {"zernike": ZernikeMask, "radial": RadialMask, "spiral": SpiralMask, "fourier": FourierMask}
    if name in families:
        return families[name](2, 23, generator=generator)
    if name == "cubic":
        return CubicMask((10 * float(torch.rand((), generator=generator)), 4.0))
    return FresnelLens(5 + 5 * float(torch.rand((), generator=generator))) if name == "fresnel" else NoMask(23)


def _lens(name: str) -> ThinLensCamera | DefocusRange:
    if name == "range":
        return DefocusRange(-12.0, 14.0)
    if name.startswith("wide"):  # the disc of infinity has a radius of 20 pixels
        return ThinLensCamera(50e-3, None, 2.0, 8e-6, (1.7, math.inf), f_number=4.0)
    return ThinLensCamera()


@cache
def _real_lens() -> Lens | None:
    return TiDyOptics(lens="single-50mm", fidelity="draft").lens


def _modulator(name: str, count: int) -> Any:
    times = tuple(range(1, count + 1))
    if name == "learnt":
        return LearnableDwellTimes(times)
    if name == "switching":
        return Switching(4e-3, dwell=DwellTimes(times), samples=2)
    if name == "efficiency":
        return DiffractionEfficiency(0.8)
    return DwellTimes() if name == "equal" else DwellTimes(times)


def _spectrum(name: str) -> Spectrum | None:
    if name == "rgb":
        return None
    return (
        Spectrum.monochrome() if name == "monochrome" else camera_spectrum(samples=4, reflectance=name == "reflectance")
    )


def _sensor(name: str, seed: int) -> SensorNoise | None:
    if name == "none":
        return None
    if name == "pattern":
        generator = torch.Generator().manual_seed(seed)
        response, offset = draw_pattern(SENSOR_SIDE, SENSOR_SIDE, dark=1e-3, columns=1e-3, generator=generator)
        return SensorNoise(0.01, response=response, offset=offset)
    return SensorNoise(0.005, full_well=2000.0, bits=8 if name == "bits" else None)


def draw_camera(choose: Choose, lenses: Sequence[str] = LENSES) -> Camera:
    """Draw how to make a camera; what contradicts another part is left out."""
    lens, compositing = choose(lenses), choose(COMPOSITINGS)
    wide, hides = lens.startswith("wide"), compositing == "occlusion"
    paper = lens == "range" and compositing == "gather" and choose((False, False, False, True))
    masks = choose(("none", "none", "none", "pixelwise") if wide else MASKS)
    spectrum = choose(SPECTRA[:3] if compositing == "occlusion" or wide else SPECTRA)
    layers = "linear" if wide else choose(("nearest", "linear", "linear", "cubic", "bandlimited"))
    sampled = wide and (masks == "pixelwise" or choose((False, False, False, True)))  # wide blur by waves
    fidelity = Fidelity(
        layers=layers,
        layer_spacing=8.0 if sampled else 0.9 if layers == "bandlimited" else choose((2.0, 5.0)),
        window=25 if sampled else None if wide else choose((None, 9, 15)),
        max_window=21,
        enclosed_energy=0.05,
        stray_light=choose(("renormalize", "renormalize", "discard", "veil")[: 3 if lens == "real" and hides else 4]),
        double=choose((False, False, True)),
        wavelengths=2 if spectrum == "binned" else None,
        occlusion_states=choose(("each", "mean")),
        wide_blur="waves" if sampled else "rays",
        field_tolerance=5e-3,
    )
    border, sensor, seed = choose(BORDERS), choose(SENSORS), choose(range(1000))
    if paper:
        fidelity = Fidelity.preset("paper")
        return Camera(lens, "published", "equal", "rgb", sensor, fidelity, compositing, border, "paper", seed)
    modulator, color_space = choose(MODULATORS), choose(("linear", "srgb"))
    return Camera(lens, masks, modulator, spectrum, sensor, fidelity, compositing, border, color_space, seed)


# ---------------------------------------------------------------------- scenes


@dataclass(frozen=True, eq=False)
class Scene:
    """An image and its depth, in what the lens takes.

    Args:
        image: (1, C, H, W).
        depth: (1, 1, H, W).
    """

    image: Tensor
    depth: Tensor


def make_scene(camera: Camera, height: int, width: int, seed: int, dtype: torch.dtype, channels: int = 3) -> Scene:
    """Return a random scene of flat and of rough parts, in depth and in light."""
    generator = torch.Generator().manual_seed(seed)
    image = (1.5 * torch.rand(1, channels, height, width, generator=generator, dtype=torch.float64) - 0.25).clamp(0, 1)
    disparity = torch.rand(1, 1, height, width, generator=generator, dtype=torch.float64)
    disparity[..., : width // 3] = float(torch.rand((), generator=generator))
    disparity[..., : height // 3, :] *= 0.5
    lo, hi = (1 / 1.7, 0.0) if camera.lens.startswith("wide") else (1 / 0.298, 0.0)
    depth = disparity if camera.lens == "range" else (hi + (lo - hi) * disparity).clamp(min=1e-3).reciprocal()
    return Scene(image.to(dtype), depth.to(dtype))


# ---------------------------------------------------------------------- events


def expose(exposure: str, optics: TiDyOptics, scene: Scene, noise: dict[str, Any]) -> Tensor:
    """Return what a camera makes of a scene.

    Args:
        exposure: one of :data:`EXPOSURES`; in motion the scene moves by a pixel from moment to moment.
        optics: the camera.
        scene: at rest, or at the first moment.
        noise: arguments of the capture; a burst takes a generator alone.
    """
    if exposure == "capture":
        return optics(scene.image, scene.depth, **noise)
    if exposure == "burst":
        return burst(optics, scene.image, scene.depth, **noise)[0]
    moments = range(len(optics.timeline(torch.float32).durations))
    images, depths = (torch.stack([part.roll(m, -2) for m in moments], 1) for part in (scene.image, scene.depth))
    return moving_capture(optics, images, depths, **noise)


@dataclass
class Life:
    """A camera whose history goes on.

    Args:
        how: it was made.
        optics: the camera.
        scene: of the last capture.
        choose: draws.
        exposure: one of :data:`EXPOSURES`.
    """

    how: Camera
    optics: TiDyOptics
    scene: Scene
    choose: Choose
    exposure: str

    def other(self, height: int | None = None, width: int | None = None, **options: Any) -> Scene:
        """Return another scene."""
        shape = self.scene.image.shape
        options = {"dtype": self.scene.image.dtype, "channels": shape[1], **options}
        return make_scene(self.how, height or shape[2], width or shape[3], self.choose(range(1000)) + 1000, **options)

    def shoot(self, noise: dict[str, Any], optics: TiDyOptics | None = None, scene: Scene | None = None) -> Tensor:
        """Return the exposure of a scene; by default that of this life, by its own camera."""
        optics, scene = optics or self.optics, scene or self.scene
        return expose(self.exposure, optics, scene, noise)

    def take(self, scene: Scene) -> None:
        """Take a capture that nobody looks at."""
        with torch.no_grad():
            self.optics(scene.image, scene.depth)


def same_scene(life: Life) -> None:
    life.take(life.scene)


def other_scene(life: Life) -> None:
    life.take(life.other())


def one_depth(life: Life) -> None:
    scene = life.other()
    life.take(replace(scene, depth=scene.depth[..., :1, :1].expand_as(scene.depth)))


def other_size(life: Life) -> None:
    height, width = life.scene.image.shape[-2:]
    life.take(life.other(height + life.choose((-1, 5)), width + life.choose((-3, 8))))


def one_channel(life: Life) -> None:
    life.take(life.other(channels=1))


def other_dtype(life: Life) -> None:
    life.take(life.other(dtype=life.choose((torch.float16, torch.float32, torch.float64))))


def a_batch(life: Life) -> None:
    scene, other = life.scene, life.other()
    life.take(Scene(torch.cat([other.image, scene.image]), torch.cat([other.depth, scene.depth])))


def no_images(life: Life) -> None:
    life.take(Scene(life.scene.image[:0], life.scene.depth[:0]))


def with_gradients(life: Life) -> None:
    scene = life.choose((life.scene, life.other()))
    image, depth = scene.image.clone().requires_grad_(), scene.depth.clone().requires_grad_()
    life.optics(image, depth).square().mean().backward()
    life.optics.zero_grad()


def with_gradients_of_psfs(life: Life) -> None:
    """Recorded and thrown away."""
    life.optics(life.scene.image, life.scene.depth)
    life.optics.psf_bank(defocus=[0.0])


def masks_that_change(life: Life) -> None:
    """Parameters move in place, are used, and come back."""
    parameters = list(life.optics.masks.parameters()) + list(life.optics.modulator.parameters())
    before = [p.detach().clone() for p in parameters]
    with torch.no_grad():
        for p in parameters:
            p.add_(torch.rand(p.shape, generator=torch.Generator().manual_seed(1)).to(p))
        life.take(life.choose((life.scene, life.other())))
        for p, was in zip(parameters, before, strict=True):
            p.copy_(was)


def masks_of_other_data(life: Life) -> None:
    """Their data are replaced and put back, which no counter of versions tells."""
    for p in life.optics.masks.parameters():
        before, p.data = p.data, torch.rand_like(p.data)
        life.take(life.scene)
        p.data = before


def other_masks(life: Life) -> None:
    before, window = life.optics.masks, life.optics.psf_model.fitted
    life.optics.masks = life.how.make(life.how.seed + 1).masks
    life.take(life.scene)
    life.optics.masks = before
    life.optics.psf_model = life.optics.psf_model.with_window(window)


def other_fidelity(life: Life) -> None:
    if life.how.fidelity.propagation == "paper":
        return
    before, window = life.optics.fidelity, life.optics.psf_model.fitted
    life.optics.fidelity = before.replace(window=11, layers="linear", layer_spacing=6.0)
    life.take(life.scene)
    life.optics.fidelity = before
    life.optics.psf_model = life.optics.psf_model.with_window(window)


def a_view(life: Life) -> None:
    view = life.optics.through_state(0)
    with torch.no_grad():
        view(life.scene.image, life.scene.depth)


def own_state_again(life: Life) -> None:
    state = {name: value.clone() for name, value in life.optics.state_dict().items()}
    life.optics.load_state_dict(state, assign=life.choose((False, True)))


def short_memory(life: Life) -> None:
    before, life.optics.memory_budget = life.optics.memory_budget, 1
    _allowed(life, lambda: life.take(life.choose((life.scene, life.other()))))
    life.optics.memory_budget = before


def questions(life: Life) -> None:
    """PSFs and what is told of a capture are asked for."""
    optics = life.optics
    with torch.no_grad():
        optics.psf_bank()
        optics.psf_bank(channels=1, defocus=[-1.0, 2.0])
        optics.explain(life.scene.image, life.scene.depth)
        str(optics)


def a_plan(life: Life) -> None:
    if life.how.fidelity.propagation != "paper":
        side = max(12, life.optics.window) if life.how.border == "valid" else 12  # that border needs whole PSFs
        life.optics.plan(life.scene.depth[..., :side, :side], life.scene.image[..., :side, :side], tolerance=1e-2)


def a_burst(life: Life) -> None:
    with torch.no_grad():
        expose("burst", life.optics, life.other(), {"generator": torch.Generator().manual_seed(3)})


def a_moving_scene(life: Life) -> None:
    with torch.no_grad():
        expose("motion", life.optics, life.other(), {"generator": torch.Generator().manual_seed(3)})


def a_failure(life: Life) -> None:
    """A capture that is refused half way."""
    with suppress(ValueError):
        life.take(replace(life.scene, depth=-life.scene.depth - 1))


def moved_and_back(life: Life) -> None:
    """Parameters in another precision and back: these have 24 bits."""
    life.optics.double()
    life.take(life.scene)
    life.optics.float()


EVENTS: dict[str, Callable[[Life], None]] = {
    event.__name__.replace("_", " "): event
    for event in (
        same_scene, other_scene, one_depth, other_size, one_channel, other_dtype, a_batch, no_images, with_gradients,
        with_gradients_of_psfs, masks_that_change, masks_of_other_data, other_masks, other_fidelity, a_view,
        own_state_again, short_memory, questions, a_plan, a_burst, a_moving_scene, a_failure, moved_and_back,
    )
}  # fmt: skip


def _allowed(life: Life, work: Callable[[], None]) -> None:
    """Work that a wide lens may refuse for its memory."""
    try:
        work()
    except ValueError as error:
        if "memory_budget allows" not in str(error) or not life.how.lens.startswith("wide"):
            raise


# ---------------------------------------------------------------------- ways to take the last capture

Noise = dict[str, Any]  # arguments of a capture that say what noise it has
Taken = tuple[Tensor, slice, bool]  # the capture, the columns that are compared, and whether to the last bit
EVERYWHERE = slice(None)


@torch.no_grad()
def plainly(life: Life, noise: Callable[[], Noise]) -> Taken:
    return life.shoot(noise()), EVERYWHERE, True


def recorded(life: Life, noise: Callable[[], Noise]) -> Taken:
    """With gradients: other kernels, so to rounding."""
    scene = replace(life.scene, image=life.scene.image.clone().requires_grad_())
    return life.shoot(noise(), scene=scene).detach(), EVERYWHERE, False


@torch.no_grad()
def unbatched(life: Life, noise: Callable[[], Noise]) -> Taken:
    return life.optics(life.scene.image[0], life.scene.depth[0], **noise())[None], EVERYWHERE, True


@torch.no_grad()
def in_a_batch(life: Life, noise: Callable[[], Noise]) -> Taken:
    """As the second of three, with the noise that it would have as the only one."""
    first, last = life.other(), life.other()
    image, depth = (torch.cat([getattr(s, part) for s in (first, life.scene, last)]) for part in ("image", "depth"))
    given = noise()
    fields = given.get("params") or life.optics.draw(life.scene.image, **given)
    fields = {name: value.expand(3, -1, -1, -1).contiguous() for name, value in fields.items()}
    return life.optics(image, depth, params=fields)[1:2], EVERYWHERE, False


@torch.no_grad()
def in_bands(life: Life, noise: Callable[[], Noise]) -> Taken:
    before, life.optics.memory_budget = life.optics.memory_budget, 1
    coded: list[Tensor] = []
    _allowed(life, lambda: coded.append(life.shoot(noise())))
    life.optics.memory_budget = before
    return (coded[0], EVERYWHERE, False) if coded else plainly(life, noise)


@torch.no_grad()
def far_away(life: Life, noise: Callable[[], Noise]) -> Taken:
    """With other pixels farther away than the PSFs reach; stray light that is spread evenly reaches everywhere."""
    other, reach, width = life.other(), life.optics.window // 2, life.scene.image.shape[-1]
    changed = 4
    if life.how.fidelity.stray_light == "veil" or width < changed + 3 * reach + 2:
        return plainly(life, noise)
    image, depth = life.scene.image.clone(), life.scene.depth.clone()
    image[..., -changed:], depth[..., -changed:] = other.image[..., -changed:], other.depth[..., -changed:]
    margin = reach if life.how.border == "valid" else 0
    first = reach if life.how.border == "circular" else 0
    columns = slice(first, width - changed - reach - margin)
    return life.shoot(noise(), scene=Scene(image, depth)), columns, False


@torch.no_grad()
def from_a_copy(life: Life, noise: Callable[[], Noise]) -> Taken:
    return life.shoot(noise(), copy.deepcopy(life.optics)), EVERYWHERE, True


@torch.no_grad()
def from_a_pickle(life: Life, noise: Callable[[], Noise]) -> Taken:
    return life.shoot(noise(), pickle.loads(pickle.dumps(life.optics))), EVERYWHERE, True


@torch.no_grad()
def from_a_state(life: Life, noise: Callable[[], Noise]) -> Taken:
    """Loaded by a camera that was made with other masks and has taken pictures."""
    optics = life.how.make(life.how.seed + 1)
    optics(life.scene.image, life.scene.depth)
    optics.load_state_dict(life.optics.state_dict())
    return life.shoot(noise(), optics), EVERYWHERE, True


@torch.no_grad()
def from_a_file(life: Life, noise: Callable[[], Noise]) -> Taken:
    """Made from a file of the state alone."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.safetensors"
        save_file({name: value.contiguous() for name, value in life.optics.state_dict().items()}, path)
        optics = camera_of_state(load_file(path))
    optics.field_center = life.optics.field_center
    return life.shoot(noise(), optics), EVERYWHERE, True


def in_a_thread(life: Life, noise: Callable[[], Noise]) -> Taken:
    """While another thread takes another scene."""
    found: list[Tensor] = []
    other, threads = life.other(), torch.get_num_threads()

    @torch.no_grad()
    def take(scene: Scene, into: list[Tensor]) -> None:
        torch.set_num_threads(threads)  # a new thread has its own number
        into.append(life.shoot(noise(), scene=scene))

    both = [threading.Thread(target=take, args=given) for given in ((life.scene, found), (other, []))]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    return found[0], EVERYWHERE, True


@torch.no_grad()
def with_fixed_layers(life: Life, noise: Callable[[], Noise]) -> Taken:
    """All layers of the camera's range, needed or not."""
    return life.shoot(noise(), life.optics.with_fixed_layers()), EVERYWHERE, False


WAYS: dict[str, Callable[[Life, Callable[[], Noise]], Taken]] = {
    way.__name__.replace("_", " "): way
    for way in (
        plainly, recorded, unbatched, in_a_batch, in_bands, far_away, from_a_copy, from_a_pickle, from_a_state,
        from_a_file, in_a_thread, with_fixed_layers,
    )
}  # fmt: skip


OF_CAPTURES = ("unbatched", "in a batch")  # not of bursts and of scenes that move
WITH_GRADIENTS = ("recorded", "with gradients", "with gradients of psfs")
# ---------------------------------------------------------------------- a history


@dataclass(frozen=True)
class History:
    """A camera, a scene, what happens, and the way of the last capture.

    Args:
        camera: how it is made.
        size: height and width of the scene.
        dtype: of the image.
        channels: of the image.
        exposure: one of :data:`EXPOSURES`.
        noise: one of :data:`NOISE`.
        events: names in :data:`EVENTS`, in their order.
        way: a name in :data:`WAYS`.
        seed: of scene, noise and whatever events draw.
    """

    camera: Camera
    size: tuple[int, int]
    dtype: torch.dtype
    channels: int
    exposure: str
    noise: str
    events: tuple[str, ...]
    way: str
    seed: int


def draw_history(choose: Choose, lenses: Sequence[str] = LENSES) -> History:
    """Draw a history."""
    camera = draw_camera(choose, lenses)
    # Gradients of occlusion are those of dense rendering: too slow here for hundreds of layers, or large PSFs.
    many = camera.lens.startswith("wide") or camera.fidelity.layers in {"cubic", "bandlimited"}
    left_out = WITH_GRADIENTS if camera.compositing == "occlusion" and many else ()
    way = choose([name for name in WAYS if name not in left_out])
    wide = camera.lens.startswith("wide")
    size = (choose((22, 25)), choose((24, 32)))
    if way == "in bands":  # of 64 rows or more
        size = 72, 24
    if way == "far away":
        size = 22, 48
    if wide:  # wide enough for the windows
        size = max(size[0], 56), 168 if way == "far away" else 60
    if camera.fidelity.propagation == "paper":  # whose PSFs the border "valid" needs whole
        size = max(size[0], 25), size[1]
    channels = 1 if camera.spectrum == "monochrome" else choose((3, 3, 1))
    events = tuple(choose([name for name in EVENTS if name not in left_out]) for _ in range(choose((1, 2, 3))))
    dtype = choose((torch.float32, torch.float32, torch.float64))
    exposure = "capture" if way in OF_CAPTURES else choose(("capture", "capture", *EXPOSURES))
    noise = "generator" if exposure == "burst" else choose(NOISE)
    return History(camera, size, dtype, channels, exposure, noise, events, way, choose(range(1000)))


@dataclass(frozen=True)
class Finding:
    """How far a capture is from that of a new camera.

    Args:
        difference: largest, full scale 1.
        bound: that it may have; 0 where bits must agree, as in float32.
    """

    difference: float
    bound: float

    @property
    def wrong(self) -> bool:
        """Whether the history changed the capture; NaN does."""
        return not self.difference <= self.bound


def live(history: History) -> Finding:
    """Live a history, and compare its last capture with that of a new camera.

    Args:
        history: to live.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is told of lenses and windows is not the question here
        return _live(history)


def _live(history: History) -> Finding:
    scene = make_scene(history.camera, *history.size, history.seed, history.dtype, history.channels)
    generator = random.Random(history.seed)
    new = history.camera.make()
    fields = new.draw(scene.image, torch.Generator().manual_seed(history.seed))

    def noise() -> Noise:
        drawn = history.noise == "generator" or not fields
        return {"generator": torch.Generator().manual_seed(history.seed)} if drawn else {"params": fields}

    with torch.no_grad():
        expected = expose(history.exposure, new, scene, noise())
    life = Life(history.camera, history.camera.make(), scene, generator.choice, history.exposure)
    for name in history.events:
        EVENTS[name](life)
    coded, columns, to_the_bit = WAYS[history.way](life, noise)
    difference = float((coded.double() - expected.double())[..., columns].abs().max())
    return Finding(difference, _LAST_BITS[rounding_of(history)] if to_the_bit else bound_of(history))


def main() -> int:
    """Live histories, and print how many changed a capture."""
    parser = argparse.ArgumentParser(prog="python -m tests.camera.histories", description="Captures after histories.")
    parser.add_argument("--count", type=int, default=2000, help="histories (default: 2000)")
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    parser.add_argument("--lenses", nargs="+", default=LENSES, choices=LENSES, help="to draw from (default: all)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    counts: Counter[tuple[str, str]] = Counter()
    nearest: dict[str, float] = {}  # largest share of the bound
    failed = 0
    for number in tqdm(range(args.count)):
        history = draw_history(random.Random(f"{args.seed} {number}").choice, args.lenses)
        camera = history.camera
        counts.update((("compositing", camera.compositing), ("lens", camera.lens), ("border", camera.border)))
        counts.update((("masks", camera.masks), ("way", history.way), *(("event", event) for event in history.events)))
        try:
            finding = live(history)
        except Exception as error:  # the next one goes on
            failed += 1
            tqdm.write(f"{number}: {type(error).__name__}: {error}\n  {history}")
            continue
        if finding.bound:
            share = finding.difference / finding.bound
            nearest[history.way] = max(share, nearest.get(history.way, 0.0))
        if finding.wrong:
            failed += 1
            tqdm.write(f"{number}: differs by {finding.difference:.1e}, allowed {finding.bound:.1e}\n  {history}")
    for (name, value), count in sorted(counts.items()):
        print(f"{name:12} {value:24} {count}")
    print("largest share of the bound:", ", ".join(f"{way} {share:.2f}" for way, share in sorted(nearest.items())))
    print(f"{args.count} histories of seed {args.seed}: {failed} changed a capture or failed")
    return failed > 0


def rounding_of(history: History) -> torch.dtype:
    """Return the data type that a capture is computed in."""
    double = history.dtype == torch.float64 or history.camera.fidelity.double
    return torch.float64 if double else torch.float32


def bound_of(history: History) -> float:
    """Return how far captures may be apart whose sums are made in another order, full scale 1."""
    bound = ROUNDING[rounding_of(history)]
    if history.camera.sensor == "bits":
        return 1 / 255 + bound  # rounding may decide for the next level
    return bound


if __name__ == "__main__":
    sys.exit(main())
