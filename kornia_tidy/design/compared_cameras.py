"""Cameras of the demonstration, at equal exposure time: shipped systems, and the lens without masks, stopped down."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.filters import bilateral_blur
from torch import Tensor, nn

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.design.candidates import FOCI, flat_candidate
from kornia_tidy.design.design_task import DesignTask, flat_mask
from kornia_tidy.design.settings import DesignSettings
from kornia_tidy.design.simulated_captures import DECISION
from kornia_tidy.masks.families import random_masks
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.head import takes_noise
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained, pretrained_settings
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.tasks import depth_logits, split_maps
from kornia_tidy.reconstruction.wiener import Wiener
from kornia_tidy.sensor.exposure import exposed_sensor
from kornia_tidy.sensor.sensor import SensorNoise

REFERENCE_F_NUMBER = DesignSettings.reference_f_number  # at which electrons are counted
BILATERAL = (7, 0.14, (2.0, 2.0))  # px, difference of encoded colours, px
MOST_DEFOCUS = 40.0  # rad between the ends of the depths of a camera that is made up
STOPS = range(-4, 3)  # quarters of a factor of two around the balanced f-number


class Camera(NamedTuple):
    """A camera at equal exposure time and, where one is shipped, the network that was trained with it."""

    optics: TiDyOptics
    head: nn.Module | None
    settings: SystemSettings | None

    @property
    def f_number(self) -> float:
        """F-number of the lens."""
        lens = self.optics.camera
        assert isinstance(lens, ThinLensCamera)
        return lens.f_number


class Result(NamedTuple):
    """The capture of a scene by one camera, and its restorations; maps are (C, H, W)."""

    capture: Tensor
    closed_form: Tensor
    image: Tensor | None
    """By the network; None where there is none."""
    inverse_depth: Tensor | None
    """By the network, normalised; None where it estimates none."""
    deviation: Tensor | None
    """Of ``inverse_depth``; None where the network does not tell it."""


def shipped_cameras(electrons: float) -> dict[str, Camera]:
    """Return the shipped systems that are shown, for the light of a white pixel at the reference f-number.

    ``"coded"`` has the most masks of those for an image in focus everywhere, ``"joint"`` of those that also estimate
    depth; of several with as many masks the one that estimates the uncertainty of its depth, else that with the largest
    f-number. ``"flat"`` has none. Each as far as one is shipped.

    Example:
        >>> round(shipped_cameras(57_000)["coded"].optics.sensor.full_well) > 10_000
        True
    """
    chosen: dict[str, tuple[str, SystemSettings]] = {}
    for name in PRETRAINED:
        settings = pretrained_settings(name)
        kind = {"edof": "coded", "joint": "joint"}.get(settings.task)
        if settings.start == "flat":
            kind = "flat" if settings.task == "edof" else None
        if kind is not None and settings.masks and (kind not in chosen or _rank(settings) > _rank(chosen[kind][1])):
            chosen[kind] = name, settings
    found = {}
    for kind, (name, settings) in chosen.items():
        system = load_pretrained(name)
        found[kind] = Camera(_exposed(system.optics, electrons), system.head, settings)
    return found


def _rank(settings: SystemSettings) -> tuple[int, int, float]:
    return settings.masks, settings.depth_classes, settings.camera().f_number


def made_up_camera(family: str, num_masks: int, f_number: float, electrons: float, seed: int) -> Camera:
    """Return a camera with random masks, whose captures the network for any camera restores without training.

    Args:
        family: of the masks, see :func:`~kornia_tidy.masks.families.random_masks`.
        num_masks: in one exposure.
        f_number: of the lens, which is else the default one. Its depths end at infinity, and span at most 40 rad of
            defocus.
        electrons: of a white pixel at the reference f-number.
        seed: of the masks.

    Example:
        >>> made_up_camera("spiral", 3, 12.0, 57_000, 0).f_number
        12.0
    """
    masks = random_masks(family, num_masks, torch.Generator().manual_seed(seed))
    lens = ThinLensCamera()
    radius = lens.focal_length / (2 * f_number)
    dioptres = min(1 / lens.depth_range[0], MOST_DEFOCUS * REFERENCE_WAVELENGTH / (math.pi * radius**2))
    camera = ThinLensCamera(f_number=f_number, focus_distance=2 / dioptres, depth_range=(1 / dioptres, math.inf))
    optics = _exposed(TiDyOptics(masks, camera), electrons)
    system = any_camera_system(optics)
    return Camera(optics, system.head, system.settings)


def stopped_down(lens: ThinLensCamera, electrons: float) -> Camera:
    """Return the lens without masks at the f-number and focus with the least predicted error of restoration.

    Args:
        lens: for whose depths and focal length.
        electrons: of a white pixel at the reference f-number.

    Example:
        >>> round(stopped_down(ThinLensCamera(), 57_000).f_number)
        48
    """
    task = DesignTask(
        depth_range=lens.depth_range,
        focal_length=lens.focal_length,
        pixel_pitch=lens.pixel_pitch,
        electrons=electrons,
        reference_f_number=REFERENCE_F_NUMBER,
    )
    numbers = [task.balanced_f_number * 2 ** (stop / 4) for stop in STOPS]
    best = min((flat_candidate(task, number, focus) for number in numbers for focus in FOCI), key=lambda one: one.cost)
    optics = TiDyOptics(flat_mask(), task.camera(best.f_number, best.focus))
    return Camera(_exposed(optics, electrons), None, None)


def _exposed(optics: TiDyOptics, electrons: float) -> TiDyOptics:
    """Return a camera with all its light and the sensor's noise for its aperture."""
    assert isinstance(optics.camera, ThinLensCamera)
    sensor = exposed_sensor(optics.camera.f_number, electrons, REFERENCE_F_NUMBER)
    return TiDyOptics(optics.masks, optics.camera, optics.modulator, sensor, DECISION, color_space=optics.color_space)


@torch.no_grad()
def photograph(camera: Camera, scene: Scene, seed: int) -> Result:
    """Photograph a scene, and restore it in closed form and by the network.

    The closed form is the Wiener filter by the statistics of scenes and the sensor's noise, then a bilateral filter.

    Source: Tomasi and Manduchi, Bilateral Filtering for Gray and Color Images (ICCV 1998).
    """
    optics, sensor = camera.optics, camera.optics.sensor
    assert isinstance(sensor, SensorNoise)
    if min(scene.image.shape[-2:]) <= optics.window // 2:
        optics.border = "replicate"  # the picture is too small to be reflected
    capture = optics(scene.image, scene.depth, generator=torch.Generator().manual_seed(seed))[None]
    light = optics.decode(capture)
    restored = optics.encode(Wiener(sensor)(light, optics.psf_bank()).clamp(0, 1))
    closed_form = bilateral_blur(restored, *BILATERAL)[0]
    if camera.head is None or camera.settings is None:
        return Result(capture[0], closed_form, None, None, None)
    told = {"noise": sensor.std(light)} if takes_noise(camera.head) else {}
    output, task = camera.head(capture, **told).float(), camera.settings.task
    maps, logits = split_maps(task, output), depth_logits(task, output)
    return Result(
        capture[0],
        closed_form,
        maps["image"][0].clamp(0, 1),
        maps["depth"][0] if "depth" in maps else None,
        None if logits is None else depth_moments(logits)[1][0],
    )
