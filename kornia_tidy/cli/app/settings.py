"""Settings of the app: scene, camera, masks and capture as plain values in SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.choices import LENSES, REPLACED, STARTS
from kornia_tidy.data.dead_leaves import MOST_LEAVES, PIXELS_A_LEAF
from kornia_tidy.optics.published_systems import SYSTEMS
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.pretrained import PRETRAINED, check_shipped
from kornia_tidy.reconstruction.settings import MaskSettings
from kornia_tidy.render.compositing import COMPOSITING

LENS = ThinLensCamera()
OWN, FLAT, FILES, CHART = "own", "flat", "files", "test chart"
SCENES = ("dead leaves", "photographic leaves", CHART, FILES)
CAMERAS = (*PRETRAINED, *SYSTEMS, OWN)
AS_SYSTEM = "system"
IDEAL = "ideal"
MOST_MASKS, STARTED_MASKS = 16, 5
SIDES = (96, 768)  # pixels
MOST_NOISE = 0.5  # of full scale; more leaves no picture
SEEDS = 2**31
ASPECT = 0.75  # rows of a painted scene for each column


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of one capture in the app.

    Args:
        scene: ``"dead leaves"``, ``"photographic leaves"``, ``"test chart"``, or ``"files"`` for image and depth files.
        seed: of the painted scene.
        side: longer side of the picture in pixels; larger files are made smaller.
        image_file: picture of the scene ``"files"``.
        depth_file: its depth map.
        depth_scale: metres per stored unit of the depth map.
        stretch: depths fill the range of the camera, linearly in inverse depth. The own camera always has the range of
            the scene.
        near: nearest depth of a painted scene in metres, if depths are not stretched.
        far: its farthest depth in metres.
        camera: name of a trained or a published system, or ``"own"``.
        f_number: focal length over aperture diameter of the own camera.
        focus_distance: its distance in focus, in metres.
        focal_length: in metres.
        pixel_pitch: of its sensor in metres.
        lens: ``"ideal"``, or the name of a real lens of the own camera, whose focal length it then has.
        place: where the picture lies in the lens's field: 0 in its middle, 1 with a corner at its edge.
        fit: focus and aperture of the own camera are chosen so that the scene's depths, their middle 99 %, have a
            defocus of -20 to +20 rad.
        start: masks of the own camera: ``"flat"`` for a plain lens, or a name of
            :func:`~kornia_tidy.masks.initial_heights.initial_heights`.
        masks: number K of its masks in one exposure.
        mask_seed: of the noise of masks.
        compositing: ``"gather"``, ``"scatter"``, ``"occlusion"``, or ``"system"`` for the compositing of the system.
        noise: standard deviation of the read noise, in units of full scale.
        noise_seed: of the noise.

    Raises:
        ValueError: if a value is not allowed, or a file is missing.

    Example:
        >>> Settings(camera="own", f_number=8).focus_distance
        0.595
        >>> Settings(noise=-1)
        Traceback (most recent call last):
        ...
        ValueError: the read noise must be from 0 to 50 % of full scale, got -100 %
    """

    scene: str = "dead leaves"
    seed: int = 0
    side: int = 320
    image_file: str | None = None
    depth_file: str | None = None
    depth_scale: float = 1.0
    stretch: bool = True
    near: float = 0.3
    far: float = 10.0
    camera: str = "joint-uncertain"
    f_number: float = round(LENS.f_number, 1)
    focus_distance: float = float(LENS.focus_distance)
    focal_length: float = LENS.focal_length
    pixel_pitch: float = LENS.pixel_pitch
    lens: str = IDEAL
    place: float = 0.0
    fit: bool = False
    start: str = "like fishers"
    masks: int = MaskSettings.masks
    mask_seed: int = 0
    compositing: str = AS_SYSTEM
    noise: float = 0.002
    noise_seed: int = 0

    @property
    def painted_size(self) -> tuple[int, int]:
        """Rows and columns of a painted scene, three to four."""
        return round(ASPECT * self.side), self.side

    @property
    def painted_leaves(self) -> int:
        """Number of leaves of the scene ``"dead leaves"``."""
        height, width = self.painted_size
        return min(MOST_LEAVES, max(1, height * width // PIXELS_A_LEAF))

    def __post_init__(self) -> None:
        check_choice("the scene", self.scene, SCENES)
        if self.camera in REPLACED:
            check_shipped(self.camera)
        check_choice("the camera", self.camera, CAMERAS)
        check_choice("compositing", self.compositing, (AS_SYSTEM, *COMPOSITING))
        check_choice("the lens", self.lens, (IDEAL, *LENSES))
        if not 0 <= self.place <= 1:
            raise ValueError(f"the place in the field must be from 0 to 100 %, got {100 * self.place:g} %")
        check_choice("the masks' start", self.start, (FLAT, *STARTS))
        for name in ("seed", "mask_seed", "noise_seed"):
            if not 0 <= getattr(self, name) < SEEDS:
                raise ValueError(f"a seed must be a whole number from 0 to {SEEDS - 1}, got {getattr(self, name)}")
        if not SIDES[0] <= self.side <= SIDES[1]:
            raise ValueError(f"the longer side must be from {SIDES[0]} to {SIDES[1]} pixels, got {self.side}")
        if not 0 <= self.noise <= MOST_NOISE:
            raise ValueError(
                f"the read noise must be from 0 to {100 * MOST_NOISE:g} % of full scale, got {100 * self.noise:g} %"
            )
        self._check_scene()
        if self.camera == OWN:
            self._check_camera()

    def _check_scene(self) -> None:
        if self.scene == FILES:
            for path, what in ((self.image_file, "a photo"), (self.depth_file, "the depth map of the photo")):
                if path is None:
                    raise ValueError(f"{what} is missing: upload both a photo and its depth map")
                if not Path(path).is_file():
                    raise FileNotFoundError(f"there is no file {Path(path).name}: upload it again")
            check_positive("metres per stored unit", self.depth_scale)
        elif not 0 < self.near < self.far < math.inf:
            raise ValueError(
                f"the nearest depth must be positive and below the farthest, got {self.near:g} m and {self.far:g} m"
            )

    def _check_camera(self) -> None:
        if not 1 <= self.masks <= MOST_MASKS:
            raise ValueError(f"the number of masks K must be from 1 to {MOST_MASKS}, got {self.masks}")
        if self.start not in {FLAT, "noise"} and self.masks > STARTED_MASKS:
            raise ValueError(
                f"the masks {self.start!r} are {STARTED_MASKS} at most, got K = {self.masks}; 'noise' has any number"
            )
        check_positive("the f-number", self.f_number)
        check_positive("the focal length", self.focal_length, "metres")
