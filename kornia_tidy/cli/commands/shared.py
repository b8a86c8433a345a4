"""Settings that several commands have, under the same names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from kornia_tidy.cli.commands.lens_option import RealLens, camera_and_lens
from kornia_tidy.reconstruction.settings import LensSettings
from kornia_tidy.settings import Electrons, Metres, Seed, Unit, one_of

if TYPE_CHECKING:
    from kornia_tidy.camera.tidy_optics import TiDyOptics
    from kornia_tidy.data.rgbd import Scene
    from kornia_tidy.lab.calibration.noise.photon_transfer import PhotonTransfer
    from kornia_tidy.masks.pixelwise import PixelwiseMask
    from kornia_tidy.optics.thin_lens import ThinLensCamera
    from kornia_tidy.psf.field_bank import FieldBank
    from kornia_tidy.psf.psf_bank import PSFBank
    from kornia_tidy.sensor.sensor import SensorNoise

File = Annotated[str, Unit("FILE")]
Out = Annotated[str, Unit("OUT")]
Folder = Annotated[str, Unit("FOLDER")]
Noise = Annotated[float | str, Unit("S|FILE", "", 0)]
Masks = Annotated[int | str, Unit("K|FILE", "", 1, 1024)]  # PSFs of more masks take days
Window = Annotated[int, Unit("PX", "pixels", 1)]

MASKS = 5  # in one exposure
OF_SENSOR = ("measured", "sigma", "full_well", "bits")
"""Settings of a system that --psfs and --noise say."""
OF_MEASURED = (
    "masks", "start", "mask_size", "design", "focal_length", "pixel_pitch", "depth_range", "f_number",
    "aperture_diameter", "focus_distance", "window", "stray_light",
)  # fmt: skip
"""Settings of a camera that are measured with its PSFs."""


@dataclass(frozen=True, kw_only=True)
class DepthFile:
    """Depth file.

    Metres are stored value * scale or, for the disparity of a stereo pair,
    baseline * focal / (stored value * scale + doffs).

    Args:
        depth_scale: metres (or pixels of disparity) per stored unit; 0.001 for a 16-bit file in millimetres, 0.0002 for
            TUM's 5000 units per metre.
        depth_kind: stored quantity.
        invalid: stored values that mean 'unknown', such as inf. NaN and a stored integer 0 always do. Unknown pixels
            take the depth of their nearest known neighbour. None: no others.
        focal_px: for disparity: focal length of the stereo pair. None: unknown.
        baseline_m: for disparity: distance between its cameras. None: unknown.
        doffs_px: for disparity: offset of their principal points.
    """

    depth_scale: Annotated[float, Unit("S")] = 1.0
    depth_kind: Annotated[str, one_of(("depth", "disparity"))] = "depth"
    invalid: tuple[Annotated[float, Unit("VALUE", infinite=True)], ...] = ()
    focal_px: Annotated[float, Unit("PX", "pixels")] | None = None
    baseline_m: Metres | None = None
    doffs_px: Annotated[float, Unit("PX", "pixels")] = 0.0

    def read(self, image: str, depth: str) -> Scene:
        """Read a picture with its depth."""
        from kornia_tidy.data.rgbd import read_rgbd

        options = dict(vars(self))
        return read_rgbd(image, depth, scale=options.pop("depth_scale"), kind=options.pop("depth_kind"), **options)


@dataclass(frozen=True, kw_only=True)
class OwnScene:
    """Your own scene.

    Args:
        image: picture of a scene: PNG, JPEG, TIFF or NPY. None: a scene that is painted here.
        depth: its depth: PNG, TIFF, PGM, PFM, NPY or OpenEXR. None: that of the painted scene.
        file: how it is stored.
    """

    image: Annotated[str, Unit("IMAGE")] | None = None
    depth: Annotated[str, Unit("DEPTH")] | None = None
    file: DepthFile = field(default_factory=DepthFile)

    def __post_init__(self) -> None:
        if (self.image is None) != (self.depth is None):
            raise ValueError("--image and --depth belong together: give both, or neither for a scene made here")

    def read(self) -> Scene | None:
        """Read the scene, if there is one."""
        return None if self.image is None or self.depth is None else self.file.read(self.image, self.depth)

    def read_or_paint(self, height: int, width: int, near: float, far: float, seed: int) -> tuple[Scene, str]:
        """Return the scene and the name of its picture, or dead leaves between two distances."""
        from kornia_tidy.data.dead_leaves import dead_leaves
        from kornia_tidy.data.rgbd import Scene

        if (scene := self.read()) is not None:
            return scene, Path(str(self.image)).name
        painted = dead_leaves(height, width, depth_range=(near, far), seed=seed)
        return Scene.whole(*painted), f"dead leaves, seed {seed}"


@dataclass(frozen=True, kw_only=True)
class SensorInElectrons:
    """Noise of the sensor.

    Args:
        full_well: electrons from black to white. None: as noise says, or, to simulate, 10500.
        read_noise: its standard deviation. None: as noise says, or, to simulate, 2.4.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: by full_well and read_noise.
    """

    full_well: Electrons | None = None
    read_noise: Electrons | None = None
    noise: Noise | None = None

    def noise_of(self, bits: int = 12, **usual: float) -> tuple[SensorNoise, PhotonTransfer | None]:
        """Return the sensor, and its calibration if it was measured.

        Args:
            bits: of its converter.
            usual: ``full_well`` and ``read_noise`` where they are not given.

        Raises:
            ValueError: if the noise is given twice, or not at all.
        """
        from kornia_tidy.sensor.sensor import SensorNoise

        given = {name: value for name in ("full_well", "read_noise") if (value := getattr(self, name)) is not None}
        if self.noise is not None:
            if given:
                raise ValueError("--noise says full well and read noise: leave out --full-well and --read-noise")
            sensor, calibration = read_noise(self.noise)
            assert sensor is not None
            return sensor, calibration
        given = {**usual, **given}
        if len(given) < 2:
            raise ValueError("the noise of the sensor is needed: --noise, or --full-well and --read-noise")
        return SensorNoise.physical(given["full_well"], given["read_noise"], bits=bits), None


@dataclass(frozen=True, kw_only=True)
class SceneLens(LensSettings):
    """Lens and sensor.

    Args:
        fit_depth: choose focus and aperture so that this scene's depths (its middle 99 %) fill psi = -20 to +20.
        lens: a real lens, whose PSFs vary over the picture, by its name; a file that Lens.save wrote; or its surfaces
            (.zmx, .seq, .json). None: an ideal lens.
    """

    fit_depth: bool = False
    lens: RealLens | None = None

    def optics_for(self, scene: Scene | None) -> dict[str, Any]:
        """Return camera and lens, as :class:`~kornia_tidy.TiDyOptics` takes them.

        Raises:
            ValueError: if two options say the same, or no lens fits.
        """
        size = None if scene is None else (scene.depth.shape[-2], scene.depth.shape[-1])
        camera, lens = camera_and_lens(self.lens, self, lambda own: own.camera_for(scene), size)
        return {"camera": camera} if lens is None else {"camera": camera, "lens": lens}

    def camera_for(self, scene: Scene | None) -> ThinLensCamera:
        """Return the camera, or the one that fits the scene.

        Raises:
            ValueError: if ``--fit-depth`` comes with an option that it chooses, or no lens fits.
        """
        if not self.fit_depth:
            return self.camera()
        from kornia_tidy.data.depth_range import middle_depths

        for name in ("f_number", "aperture_diameter", "focus_distance", "depth_range"):
            if getattr(self, name) is not None:
                raise ValueError(f"--fit-depth chooses --{name.replace('_', '-')}: give one of the two")
        if scene is None:
            raise ValueError("--fit-depth needs a scene with a range of depths")
        return replace(self, depth_range=middle_depths(scene.depth, scene.valid)).camera()


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Masks.

    Args:
        masks: number of masks of random height in one exposure, or a file of heights. None: 5.
        mask_seed: seed of random heights. None: 0.
        psfs: the camera whose PSFs kornia-tidy raw calibrate-psf measured, with lens, masks and distances. None:
            computed for lens and masks.
        lens: of the camera.
    """

    lens: SceneLens = field(default_factory=SceneLens)
    masks: Masks | None = None
    mask_seed: Seed | None = None
    psfs: File | None = None

    def optics(self, scene: Scene | None, **options: Any) -> TiDyOptics:
        """Return the camera: the measured one, or one of lens and masks.

        Args:
            scene: for ``--fit-depth``, if there is one.
            options: further ones of :class:`~kornia_tidy.TiDyOptics`.

        Raises:
            ValueError: if ``--psfs`` comes with an option for a measured property.
        """
        from kornia_tidy.camera.tidy_optics import TiDyOptics

        if self.psfs is not None:
            from kornia_tidy.lab.calibration.psf.measured_camera import measured_camera

            of_lens = [name for name, value in vars(self.lens).items() if value != getattr(SceneLens(), name)]
            given = [name for name in ("masks", "mask_seed") if getattr(self, name) is not None]
            refuse_with_psfs([*of_lens, *given])
            return measured_camera(self.psfs, **options)
        if isinstance(self.masks, str) and self.mask_seed is not None:
            raise ValueError("--mask-seed is of masks of random height, and --masks is a file: leave one of them out")
        shown = masks_of(MASKS if self.masks is None else self.masks, self.mask_seed or 0)
        return TiDyOptics(shown, **self.lens.optics_for(scene), **options)

    def in_words(self, optics: TiDyOptics) -> str:
        """Describe the masks of the camera."""
        if self.psfs is not None:
            return f"as they were when the PSFs of {self.psfs} were measured"
        origin = self.masks if isinstance(self.masks, str) else f"noise of seed {self.mask_seed or 0}"
        return f"{optics.masks.extra_repr()}, {origin}"


def masks_of(masks: int | str, seed: int = 0) -> PixelwiseMask:
    """Return the masks of ``--masks``: a number of them of random height, or those of a file of heights.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it cannot be read, or has no masks.
    """
    import torch

    from kornia_tidy.lab.mask_export.mask_files import read_heights
    from kornia_tidy.masks.pixelwise import PixelwiseMask

    if isinstance(masks, str):
        if not Path(masks).exists():
            raise FileNotFoundError(f"--masks is a number or a file (.npy, .safetensors): there is no file {masks:.80}")
        return PixelwiseMask(initial=read_heights(masks))
    return PixelwiseMask(masks, generator=torch.Generator().manual_seed(seed))


def refuse_with_psfs(given: Iterable[str]) -> None:
    """Raise ``ValueError`` if an option was given for what ``--psfs`` says: lens, masks and distances."""
    for name in given:
        raise ValueError(f"--psfs has its own lens, masks and distances: leave out --{name.replace('_', '-')}")


def read_noise(given: float | str | None) -> tuple[SensorNoise | None, PhotonTransfer | None]:
    """Return the sensor of ``--noise``, and the calibration if it was measured; None for a missing one.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file holds no calibration of the noise.
    """
    if given is None:
        return None, None
    from kornia_tidy.lab.calibration.noise.photon_transfer import read_json
    from kornia_tidy.sensor.sensor import SensorNoise

    if not isinstance(given, str):
        return SensorNoise(given), None
    if not Path(given).exists():
        raise FileNotFoundError(
            f"--noise is a number, of full scale, or a file of raw calibrate-noise: there is no file {given:.80}"
        )
    measured = read_json(given)
    return measured.sensor_noise(), measured


def measured_system(
    psfs: str | None, noise: float | str | None, given: Iterable[str]
) -> tuple[dict, PSFBank | FieldBank | None]:
    """Return the settings of the camera that --psfs and --noise say, and the measured PSFs, if any.

    Args:
        psfs: file of measured PSFs.
        noise: standard deviation of the read noise, or a file of its calibration.
        given: names of the settings that were given otherwise.

    Raises:
        FileNotFoundError: if a file is not there.
        ValueError: if a file is of another kind, or a setting was given that was measured with the PSFs.
    """
    from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs
    from kornia_tidy.lab.measured import measured_settings, noise_settings

    sensor, _ = read_noise(noise)
    settings: dict[str, Any] = {} if sensor is None else noise_settings(sensor)
    if psfs is None:
        return settings, None
    refuse_with_psfs(name for name in OF_MEASURED if name in given)
    measured = MeasuredPSFs.load(psfs)
    return {**settings, **measured_settings(measured)}, measured.bank


def check_output(path: str, *inputs: str | None, bits: int = 8) -> None:
    """Check before any work that a picture can be written to a path and does not replace an input.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the suffix is not a picture's, cannot hold the bits, or the file is an input.
    """
    from kornia_tidy.checks import check_choice
    from kornia_tidy.data.image_files import SUFFIXES

    suffix = Path(path).suffix.lower()
    check_choice("the suffix of an image file", suffix, SUFFIXES)
    check_choice(f"bits of a {suffix} file", bits, (8,) if suffix in {".jpg", ".jpeg"} else (8, 16))
    check_outputs([path], inputs)


def picture_beside(picture: str | None, output: str) -> Path | None:
    """Return where a command draws its numbers: as given, else beside its output, if matplotlib is installed.

    Raises:
        ImportError: if a picture was asked for, and matplotlib is missing.
    """
    from kornia_tidy.figures.style import require_matplotlib

    try:
        require_matplotlib()
    except ImportError:
        if picture is not None:
            raise
        return None
    return Path(picture or Path(output).with_suffix(".png"))


def check_once(files: Iterable[str]) -> None:
    """Raise ``ValueError`` for a capture that is given twice, under whichever path: it would count as two."""
    found: set[Path] = set()
    for file in files:
        if (place := Path(file).resolve()) in found:
            raise ValueError(f"{file} is given twice, and each capture counts once")
        found.add(place)


def check_outputs(outputs: Iterable[str | Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Check before any work that outputs can be written and do not replace inputs; None is skipped.

    Raises:
        FileNotFoundError: if a folder does not exist.
        ValueError: if an output is a folder or an input.
    """
    from kornia_tidy.files import check_writable

    there = [Path(other) for other in inputs if other is not None and Path(other).exists()]
    for path in (Path(output) for output in outputs if output is not None):
        check_writable(path)
        if path.exists() and any(path.samefile(other) for other in there):
            raise ValueError(f"cannot write {path}: it is an input")
