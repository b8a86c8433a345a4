"""`kornia-tidy raw simulate`: simulation of a camera's raw file of a scene with depth, or of a calibration target."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from kornia_tidy.choices import Compositing, Preset
from kornia_tidy.cli.commands.raw_options import Pattern, Size
from kornia_tidy.cli.commands.shared import CameraSettings, DepthFile, File, SensorInElectrons, check_outputs
from kornia_tidy.settings import Count, Metres, Seed, Unit, one_of

if TYPE_CHECKING:
    import torch

    from kornia_tidy.lab.raw.capture import RawCapture
    from kornia_tidy.sensor.sensor import SensorNoise

USUAL = {"full_well": 10500.0, "read_noise": 2.4}  # electrons: a small industrial sensor of 3.45 um pixels
PATTERN, BITS = "RGGB", 12
WIDTH, HEIGHT = 640, 480  # of a sheet
BRIGHTEST = 0.8  # of full scale, of points of light: as a laboratory exposes them


@dataclass(frozen=True, kw_only=True)
class SensorOptions(SensorInElectrons):
    """Sensor.

    That of a raw file, or one given in words.

    Args:
        like: raw file that gives filter array, levels and colours. None: the sensor is given in words.
        pattern: filter array's tile, by rows. None: RGGB.
        bits: of the converter; white is 2^bits - 1. None: 12.
        black: count without light. None: 2^bits / 16.
        white: saturation count, replaces that of the file of like. None: as the file of like says, or by bits.
        color: camera: the picture's colours are seen through the camera's filters, by its matrix and white balance;
            channels: red, green and blue are the camera's own. None: camera with like, else channels.
        seed: of the noise.
    """

    like: File | None = None
    pattern: Pattern | None = None
    bits: Annotated[int, one_of((10, 12, 14, 16))] | None = None
    black: Annotated[int, Unit("N", "counts", 0)] | None = None
    white: Annotated[float, Unit("N", "counts")] | None = None
    color: Annotated[str, one_of(("camera", "channels"))] | None = None
    seed: Seed = 0


@dataclass(frozen=True, kw_only=True)
class SimulateRaw:
    r"""Make a raw file from a picture and its depth.

    The scene is a picture with a depth map of the same size. It is blurred by the lens with
    its K phase masks, sampled through the filter array, and recorded with the camera's
    noise, black and white level. The result is an uncompressed DNG, which any raw software
    opens. Masks of random height have 23 x 23 pixels: the start of training.

    Instead of a scene, the targets of a calibration: an evenly lit sheet (--flat) for raw
    calibrate-noise, or a sheet with pinholes (--points, --distance) for raw calibrate-psf.

    Args:
        output: DNG to write.
        image: picture: PNG, JPEG, TIFF or NPY. None: another target.
        depth: of the picture: PNG, TIFF, PGM, PFM, NPY, OpenEXR. None: none.
        flat: instead: an evenly lit sheet, of full scale; 0: the lens cap. None: another target.
        points: instead: points of light in a sheet. None: another target.
        distance: of the points. None: there are no points.
        size: of a sheet. None: 640x480.
        fidelity: speed or accuracy.
        compositing: how depths are put together.
        sensor: that records the light.
        optics: lens and masks.
        file: how the depth is stored.

    Notes:
        The picture in Python: kornia_tidy.lab.raw.simulation.simulate_scene.

    Examples:
        For one's own camera: filter array, levels and colours of one of its files, and its
        noise from 'kornia-tidy raw calibrate-noise':
          kornia-tidy raw simulate --image rgb.png --depth depth.png --depth-scale 0.001 \
              --like shot.cr2 --noise iso800.json -o coded.dng

        A 14-bit sensor that is given in words:
          kornia-tidy raw simulate --image rgb.png --depth depth.pfm --pattern GBRG \
              --bits 14 --full-well 30000 --read-noise 3 -o coded.dng

        A dark capture, a flat, and 24 points at half a metre, to try out a calibration:
          kornia-tidy raw simulate --flat 0 -o dark.dng
          kornia-tidy raw simulate --flat 0.5 -o flat.dng
          kornia-tidy raw simulate --points 24 --distance 0.5 --size 1008x672 -o point0.5.dng
    """

    output: Annotated[str, Unit("OUT.dng")]
    image: Annotated[str, Unit("IMAGE")] | None = None
    depth: Annotated[str, Unit("DEPTH")] | None = None
    flat: Annotated[float, Unit("L", "", 0, 1)] | None = None
    points: Count | None = None
    distance: Metres | None = None
    size: Size | None = None
    fidelity: Preset = "balanced"
    compositing: Compositing = "gather"
    sensor: SensorOptions = field(default_factory=SensorOptions)
    optics: CameraSettings = field(default_factory=CameraSettings)
    file: DepthFile = field(default_factory=DepthFile)

    basic: ClassVar = (
        *("output", "image", "depth", "depth_scale", "flat", "points", "distance", "size", "like", "pattern", "bits"),
        *("full_well", "read_noise", "noise", "seed", "masks", "psfs", "depth_range", "f_number", "fit_depth"),
    )

    def __post_init__(self) -> None:
        if sum(target is not None for target in (self.image, self.flat, self.points)) != 1:
            raise ValueError("one of --image, --flat and --points is needed")

    def run(self) -> None:
        """Simulate the capture and write it."""
        output = Path(self.output)
        self._check(output)
        import torch

        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.raw.dng_writer import write_dng
        from kornia_tidy.lab.raw.simulation import simulate_raw

        generator = torch.Generator().manual_seed(self.sensor.seed)
        camera = self._camera()
        noise, calibration = self.sensor.noise_of(16, **USUAL)
        if calibration is not None and self.sensor.like is not None:
            calibration.check_taken_alike(camera, self.sensor.like)
        with torch.no_grad():
            if self.image is not None:
                raw = self._scene(camera, noise, generator)
            else:
                light = self._target(3 if camera.colors else 1, generator)
                raw = simulate_raw(light, camera, noise, color=self._color(), generator=generator)
        saturated = float((raw.counts >= int(raw.white)).float().mean())
        letters = raw.pattern_letters or "no"
        tell("sensor", f"{letters} filter array, white {raw.white:g}, {saturated:.2%} of the pixels there; {noise}")
        write_dng(output, raw)
        tell("wrote", f"{output}, {raw.counts.shape[-1]} x {raw.counts.shape[-2]} px")

    def _scene(self, camera: RawCapture, noise: SensorNoise, generator: torch.Generator) -> RawCapture:
        """Return the capture of a picture with depth."""
        from kornia_tidy.cli.commands.report import clamped_in_words, light_in_words, scene_in_words, tell
        from kornia_tidy.lab.raw.simulation import simulate_scene

        assert self.image is not None
        assert self.depth is not None
        scene = self.file.read(self.image, self.depth)
        tell("scene", scene_in_words(scene))
        optics = self.optics.optics(scene, sensor=None, fidelity=self.fidelity, compositing=self.compositing)
        bank = optics.psf_bank(channels=3 if camera.colors else 1)
        tell("lens", (optics.camera if optics.lens is None else optics.lens).extra_repr())
        tell("masks", self.optics.in_words(optics))
        tell("PSFs", light_in_words(bank, optics))
        raw = simulate_scene(scene.image, scene.depth, optics, camera, noise, color=self._color(), generator=generator)
        tell("clamped", clamped_in_words(optics, scene.depth))
        return raw

    def _target(self, channels: int, generator: torch.Generator) -> torch.Tensor:
        """Return the light of a calibration target, (channels, rows, columns)."""
        import torch

        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.raw.point_targets import points_of_light

        rows, columns = (HEIGHT, WIDTH) if self.size is None else self.size
        if self.flat is not None:
            tell("target", f"an evenly lit sheet, {self.flat:g} of full scale")
            return torch.full((channels, rows, columns), self.flat)
        assert self.distance is not None
        assert self.points is not None
        optics = self.optics.optics(None, sensor=None, fidelity=self.fidelity)
        tell("lens", optics.camera.extra_repr())
        tell("target", f"{self.points} points of light at {self.distance:g} m, up to {BRIGHTEST:g} of full scale")
        return BRIGHTEST * points_of_light(optics, self.distance, self.points, (rows, columns), channels, generator)

    def _color(self) -> str:
        return self.sensor.color or ("camera" if self.sensor.like else "channels")

    def _camera(self) -> RawCapture:
        """Return the sensor of a raw file or of the settings."""
        from kornia_tidy.lab.raw.capture import RawCapture
        from kornia_tidy.lab.raw.simulation import simulated_sensor

        if self.sensor.like is not None:
            for name in ("pattern", "bits", "black"):
                if getattr(self.sensor, name) is not None:
                    raise ValueError(f"--like has its own sensor: leave out --{name}")
            return RawCapture.open(self.sensor.like, white=self.sensor.white)
        if self.sensor.white is not None:
            raise ValueError("--white is of the file of --like: give that, or --bits")
        return simulated_sensor(self.sensor.pattern or PATTERN, self.sensor.bits or BITS, self.sensor.black)

    def _check(self, output: Path) -> None:
        """Check before any work that the output can be written, and that the settings are of one target."""
        if output.suffix.lower() != ".dng":
            raise ValueError(f"the output must be a .dng file, got {output}")
        noise = self.sensor.noise if isinstance(self.sensor.noise, str) else None
        check_outputs([output], [self.image, self.depth, self.sensor.like, noise, self.optics.psfs])
        needs = {"--depth": ("image", self.depth), "--distance": ("points", self.distance)}
        for option, (target, value) in needs.items():
            if (value is None) != (getattr(self, target) is None):
                raise ValueError(f"--{target} and {option} go together, got only one of them")
        if self.image is not None and self.size is not None:
            raise ValueError("--size is of --flat and --points: a picture has its own")
