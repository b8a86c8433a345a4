"""From settings to a capture and its reconstruction: camera, scene, capture, restored image and estimated depth."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.cli.app.scenes import read_files
from kornia_tidy.cli.app.settings import AS_SYSTEM, FILES, FLAT, IDEAL, OWN, Settings
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.data.depth_range import middle_depths
from kornia_tidy.data.photographic_leaves import photographic_leaves
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.masks.initial_heights import initial_heights
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.lens import NAMED_LENSES
from kornia_tidy.optics.lens.lens import LensRangeWarning
from kornia_tidy.optics.lens.made_lenses import named_focal_length
from kornia_tidy.optics.published_systems import SYSTEMS
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.metrics import psnr, rmse
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth, split_maps, stretched
from kornia_tidy.reconstruction.trained import TrainedSystem, update_psfs
from kornia_tidy.sensor.sensor import SensorNoise

WIDEST_BLUR = 65  # pixels; the PSF window of a capture holds no more

Tell = Callable[[float, str], None]


@dataclass(frozen=True)
class Result:
    """A capture, its scene and camera, and its reconstruction; pictures are (C, H, W)."""

    settings: Settings
    scene: Scene
    optics: TiDyOptics
    camera: ThinLensCamera
    capture: Tensor
    image: Tensor
    """Reconstructed all-in-focus image."""
    inverse_depth: Tensor
    """Normalised inverse depth of the scene: 0 at the far and 1 at the near end of the camera's range."""
    estimate: Tensor | None
    """Estimated normalised inverse depth; None if the camera has no network for depth."""
    clamped: float
    """Share of the pixels beyond the camera's range."""

    def scores(self) -> dict[str, float]:
        """Return PSNR (dB) of capture and image, and RMSE of the normalised inverse depth beside that of its mean."""
        truth, where = self.scene.image[None], self.scene.valid[None]
        found = {
            "capture_psnr": float(psnr(self.capture[None], truth)),
            "image_psnr": float(psnr(self.image[None].clamp(0, 1), truth)),
        }
        if self.estimate is None:
            return found
        known = self.inverse_depth[None]
        flat = torch.full_like(known, float(known[where].mean()))
        found["depth_rmse"] = float(rmse(self.estimate[None].clamp(0, 1), known, where))
        return {**found, "mean_rmse": float(rmse(flat, known, where))}


@torch.no_grad()
def take_picture(settings: Settings, tell: Tell = lambda share, stage: None) -> Result:
    """Photograph the scene of the settings, and reconstruct image and depth from the capture.

    Args:
        settings: scene, camera, masks and noise.
        tell: called before each stage with the share of the work that is done, and the stage in words.

    Returns:
        The capture and its reconstruction. Trained systems are reconstructed by their network, all others by the
        network for any camera, which gives no depth.

    Raises:
        ValueError: if the camera cannot be made, its blur is wider than the PSFs of a capture, or files do not fit.

    Example:
        >>> result = take_picture(Settings(side=96))
        >>> result.capture.shape, result.estimate.shape
        (torch.Size([3, 72, 96]), torch.Size([1, 72, 96]))
    """
    with warnings.catch_warnings(), _known_lens():
        warnings.simplefilter("ignore", UserWarning)  # pixels beyond the range are counted in the result
        warnings.simplefilter("error", LensRangeWarning)
        tell(0.05, "scene")
        if settings.camera == OWN:
            scene = read_scene(settings, None)
            tell(0.2, "camera")
            camera, size = own_camera(settings, scene), (scene.depth.shape[-2], scene.depth.shape[-1])
            optics, system = own_optics(settings, camera, size), None
        else:
            optics, system = known_system(settings.camera, settings.compositing, settings.noise, settings.mask_seed)
            scene = read_scene(settings, _lens(optics) if settings.stretch else None)
        camera = _lens(optics)
        tell(0.4, "PSFs and capture")
        generator = torch.Generator().manual_seed(settings.noise_seed)
        capture = optics(scene.image, scene.depth, generator=generator)
        clamped = optics.clamped_pixels / scene.depth.numel()
        tell(0.7, "reconstruction")
        image, estimate = reconstruct(capture, optics, system)
    truth = normalised_inverse_depth(camera, scene.depth)
    return Result(settings, scene, optics, camera, capture, image, truth, estimate, clamped)


def read_scene(settings: Settings, camera: ThinLensCamera | None) -> Scene:
    """Return the scene of the settings, its depths stretched over the range of a camera, if there is one."""
    if settings.scene == FILES:
        assert settings.image_file is not None
        assert settings.depth_file is not None
        scene = read_files(settings.image_file, settings.depth_file, settings.depth_scale, settings.side)
        if camera is None:
            return scene
        depth_ends(scene)
        return scene._replace(depth=stretched(scene.depth, scene.valid, camera))
    depth_range = (settings.near, settings.far) if camera is None else camera.depth_range
    return painted(settings.scene, *settings.painted_size, depth_range, settings.painted_leaves, settings.seed)


@lru_cache(4)
def painted(name: str, height: int, width: int, depth_range: tuple[float, float], leaves: int, seed: int) -> Scene:
    """Return a painted scene; ``leaves`` is the number of dead leaves."""
    if name == "dead leaves":
        image, depth = dead_leaves(height, width, depth_range=depth_range, num_leaves=leaves, seed=seed)
    else:
        image, depth = photographic_leaves(height, width, depth_range=depth_range, seed=seed)
    return Scene.whole(image, depth)


def own_camera(settings: Settings, scene: Scene) -> ThinLensCamera:
    """Return the lens of the settings for the depths of a scene.

    Raises:
        ValueError: if the lens cannot be made, or its blur is wider than the PSFs of a capture.
    """
    focal_length, pixel_pitch = settings.focal_length, settings.pixel_pitch
    if settings.lens != IDEAL:
        focal_length = named_focal_length(settings.lens)
    if settings.fit:
        return ThinLensCamera.for_scene(depth_ends(scene), focal_length=focal_length, pixel_pitch=pixel_pitch)
    nearest, farthest = (float(end) for end in scene.depth.aminmax())
    if nearest == farthest:
        nearest, farthest = 0.9 * nearest, 1.1 * farthest  # a range needs two ends
    aperture = focal_length / settings.f_number
    camera = ThinLensCamera(focal_length, aperture, settings.focus_distance, pixel_pitch, (nearest, farthest))
    check_blur(camera)
    return camera


def depth_ends(scene: Scene) -> tuple[float, float]:
    """Return the nearest and farthest depth in metres of the middle 99 % of a scene.

    Raises:
        ValueError: if the whole scene lies at one depth.
    """
    try:
        return middle_depths(scene.depth, scene.valid)
    except ValueError:
        depth = float(scene.depth[scene.valid].median())
        raise ValueError(
            f"the whole scene lies at {depth:.3g} m, and one depth cannot be stretched or fitted: switch that off"
        ) from None


def check_blur(camera: ThinLensCamera) -> None:
    """Raise ``ValueError`` if a point out of focus is wider than the PSFs of a capture.

    By rays a point out of focus is a disc of diameter ``2 |psi| 530 nm s' / (pi R)`` on the sensor, R the radius of the
    aperture and s' the image distance.

    Example:
        >>> check_blur(ThinLensCamera(aperture_diameter=0.01))
        Traceback (most recent call last):
        ...
        ValueError: at f/5 a point at inf m is 115 pixels wide, and 65 are allowed here: raise the f-number, or bring \
focus and depths closer together
    """
    lo, hi = camera.defocus_range
    psi, depth = max((abs(lo), camera.depth_range[1]), (abs(hi), camera.depth_range[0]))
    width = 2 * psi * REFERENCE_WAVELENGTH * float(camera.image_distance)
    width /= math.pi * camera.aperture_radius * camera.pixel_pitch
    if width > WIDEST_BLUR:
        raise ValueError(
            f"at f/{camera.f_number:.3g} a point at {depth:.3g} m is {width:.0f} pixels wide, and {WIDEST_BLUR} are "
            f"allowed here: raise the f-number, or bring focus and depths closer together"
        )


@contextmanager
def _known_lens() -> Generator[None]:
    """Raise ``ValueError`` where a lens is asked for depths or heights that its table does not hold."""
    try:
        yield
    except LensRangeWarning as warning:
        raise ValueError(f"{str(warning).partition(',')[0]}: choose another focus, depths or size") from None


def field_center(settings: Settings, camera: ThinLensCamera, size: tuple[int, int]) -> tuple[float, float]:
    """Return where the middle of a picture lies in the field of the lens, y and x in whole pixels from its axis.

    Example:
        >>> field_center(Settings(lens="single-50mm", place=1.0), ThinLensCamera(), (240, 320))
        (458.0, 458.0)
    """
    if settings.lens == IDEAL:
        return 0.0, 0.0
    free = NAMED_LENSES[settings.lens]["field"] / camera.pixel_pitch - math.hypot(*size) / 2
    along = float(math.floor(settings.place * max(0.0, free) / math.sqrt(2)))
    return along, along


def own_optics(settings: Settings, camera: ThinLensCamera, size: tuple[int, int]) -> TiDyOptics:
    """Return the camera with the lens, masks, compositing and noise of the settings, for a picture of a size."""
    noise = torch.Generator().manual_seed(settings.mask_seed)
    if settings.start == FLAT:
        masks = PixelwiseMask(1, initial="flat")
    elif settings.start == "noise":
        masks = PixelwiseMask(settings.masks, generator=noise)
    else:
        masks = PixelwiseMask(initial=initial_heights(settings.start, noise)[: settings.masks])
    compositing = "gather" if settings.compositing == AS_SYSTEM else settings.compositing
    lens, center = None if settings.lens == IDEAL else settings.lens, field_center(settings, camera, size)
    sensor = SensorNoise(settings.noise)
    return TiDyOptics(masks, camera, sensor=sensor, compositing=compositing, lens=lens, field_center=center)


@lru_cache(8)
def known_system(name: str, compositing: str, noise: float, mask_seed: int) -> tuple[TiDyOptics, TrainedSystem | None]:
    """Return the camera of a published or trained system with another compositing and noise, and the trained system."""
    sensor = SensorNoise(noise)
    changed = {} if compositing == AS_SYSTEM else {"compositing": compositing}
    if name in SYSTEMS:
        generator = torch.Generator().manual_seed(mask_seed)
        return TiDyOptics.from_preset(name, generator=generator, sensor=sensor, **changed), None
    system = load_pretrained(name)
    system.optics.sensor = sensor
    system.optics.compositing = changed.get("compositing", system.optics.compositing)
    with torch.no_grad():
        update_psfs(system.head, system.optics)  # tells the network of the noise
    return system.optics, system


def reconstruct(capture: Tensor, optics: TiDyOptics, system: TrainedSystem | None) -> tuple[Tensor, Tensor | None]:
    """Return the all-in-focus image, and the normalised inverse depth if the system is trained for it."""
    if system is None:
        head = LightHead(any_camera_system(optics))
        image = reconstruct_light(head, optics.decode(capture[None])[0]).image
        assert image is not None  # of a head for images
        return image, None
    maps = split_maps(system.settings.task, system.head(capture[None]))
    depth = maps.get("depth")
    return maps["image"][0].clamp(0, 1), None if depth is None else depth[0].clamp(0, 1)


def _lens(optics: TiDyOptics) -> ThinLensCamera:
    assert isinstance(optics.camera, ThinLensCamera)  # of every system here
    return optics.camera
