"""`kornia-tidy simulate`: simulation of the coded capture of one picture with depth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from kornia_tidy.choices import HOLES, Border, ColorSpace, Compositing, Preset
from kornia_tidy.cli.commands.parser import Argument
from kornia_tidy.cli.commands.shared import CameraSettings, DepthFile, Noise, check_output, read_noise
from kornia_tidy.settings import Seed, Unit, one_of


@dataclass(frozen=True, kw_only=True)
class Simulate:
    r"""Make the coded capture of a picture and its depth.

    The camera shows its K phase masks one after another during one exposure. The scene is
    a picture and a depth map of the same size. Masks of random height have 23 x 23 pixels:
    the start of training.

    Args:
        image: picture: PNG, JPEG, TIFF, 8 or 16 bits, or NPY in [0, 1].
        depth: its depth: PNG, TIFF, PGM, PFM, NPY, OpenEXR.
        output: PNG, TIFF or JPEG to write. None: IMAGE_coded.png, in this folder.
        bits: of a sample of the output.
        seed: of the sensor's noise.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: 0.01.
        holes: pixels of unknown depth: error refuses them, fill takes the depth of the nearest known pixel.
        fidelity: speed or accuracy.
        compositing: gather: each pixel collects light through its own depth's PSF, as the paper; scatter: each spreads
            its light, which conserves it; occlusion: near things hide far ones, slowest.
        border: continuation of the picture beyond its edges; valid crops the capture instead.
        color_space: srgb: decoded to linear light and encoded after; linear: is light already; paper: sRGB taken for
            light, as the paper does. None: srgb, or paper with that fidelity.
        file: how the depth is stored.
        camera: lens and masks.

    Notes:
        The first example in Python, the same but for the rounding to 8 bits:
          import torch
          from kornia_tidy import PixelwiseMask, TiDyOptics
          from kornia_tidy.data.rgbd import read_rgbd
          image, depth, valid = read_rgbd("rgb.png", "depth.png", scale=0.001)
          optics = TiDyOptics(PixelwiseMask(5, generator=torch.Generator().manual_seed(0)))
          coded = optics(image, depth, generator=torch.Generator().manual_seed(0))

    Examples:
        A Kinect frame, depth in millimetres:
          kornia-tidy simulate rgb.png --depth depth.png --depth-scale 0.001 --holes fill \
              -o coded.png

        A Middlebury stereo scene, with a lens chosen for its depths:
          kornia-tidy simulate im0.png --depth disp0.pfm --depth-kind disparity \
              --invalid inf --focal-px 999.421 --baseline-m 0.193001 --doffs-px 32.778 \
              --holes fill --fit-depth

        Through a real lens, from a file of an optical program:
          kornia-tidy simulate rgb.png --depth depth.png --depth-scale 0.001 --lens lens.zmx \
              --f-number 8 --focus-distance 1.5 --fidelity draft
    """

    image: Annotated[str, Argument("IMAGE")]
    depth: Annotated[str, Unit("DEPTH")]
    output: Annotated[str, Unit("OUT")] | None = None
    bits: Annotated[int, one_of((8, 16))] = 8
    seed: Seed = 0
    noise: Noise | None = None
    holes: Annotated[str, one_of(HOLES)] = "error"
    fidelity: Preset = "balanced"
    compositing: Compositing = "gather"
    border: Border = "reflect"
    color_space: ColorSpace | None = None
    camera: CameraSettings = field(default_factory=CameraSettings)
    file: DepthFile = field(default_factory=DepthFile)

    basic: ClassVar = (
        *("image", "depth", "output", "seed", "noise", "holes", "fidelity", "compositing", "masks", "mask_seed"),
        *("psfs", "focal_length", "f_number", "focus_distance", "depth_range", "pixel_pitch", "fit_depth", "lens"),
        "depth_scale",
    )

    def run(self) -> None:
        """Simulate the capture and write it."""
        import torch

        from kornia_tidy.cli.commands.report import clamped_in_words, light_in_words, scene_in_words, tell, tell_camera
        from kornia_tidy.data.image_files import write_image
        from kornia_tidy.sensor.sensor import SensorNoise

        output = self.output or f"{Path(self.image).stem}_coded.png"
        check_output(output, self.image, self.depth, self.camera.psfs, bits=self.bits)
        sensor, _ = read_noise(self.noise)
        with torch.no_grad():
            scene = self.file.read(self.image, self.depth)
            if self.holes == "error" and (count := int((~scene.valid).sum())):
                raise ValueError(
                    f"{self.depth} has no depth at {count} of its {scene.valid.numel()} pixels: take it from the "
                    f"nearest known ones with --holes fill"
                )
            tell("scene", scene_in_words(scene))

            optics = self.camera.optics(
                scene,
                sensor=sensor or SensorNoise(),
                fidelity=self.fidelity,
                compositing=self.compositing,
                color_space=self.color_space,
                border=self.border,
            )
            bank = optics.psf_bank(channels=scene.image.shape[0])
            tell_camera(optics, self.camera.in_words(optics))
            tell("PSFs", light_in_words(bank, optics))
            tell(
                "capture", f"{optics.compositing}, {optics.border} border, {optics.color_space} colour, {optics.sensor}"
            )

            coded = optics(scene.image, scene.depth, generator=torch.Generator().manual_seed(self.seed))
        tell("clamped", clamped_in_words(optics, scene.depth))
        write_image(output, coded, bits=self.bits)
        tell("wrote", f"{output}, {coded.shape[-1]} x {coded.shape[-2]} px, {self.bits} bits")
