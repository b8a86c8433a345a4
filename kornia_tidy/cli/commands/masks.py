"""`kornia-tidy masks`: export of masks to SLM frames or heights, and import of frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from kornia_tidy.choices import FLIPS, MATERIALS, ROTATIONS
from kornia_tidy.cli.commands.parser import Argument
from kornia_tidy.cli.commands.raw_options import Size
from kornia_tidy.cli.commands.shared import File
from kornia_tidy.settings import Metres, Seconds, Unit, one_of

if TYPE_CHECKING:
    from torch import Tensor

    from kornia_tidy.lab.mask_export.mask_files import SavedMasks
    from kornia_tidy.optics.materials import Material

MasksFile = Annotated[str, Argument("MASKS")]
MaterialName = Annotated[str, one_of(MATERIALS)]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Panel (frames).

    Args:
        bits: of a grey level. None: as saved, or 8.
        wavelength: the panel's working wavelength.
        phase_range: phase at that wavelength that the levels span. None: as saved, or 2 pi.
        response: instead: its measured phases at that wavelength, as text: one for each level, or two columns, level
            and phase; radians, or the unit that a header names (deg, pi, waves). None: levels that are evenly spaced.
        panel: its size. None: 1920x1200.
        panel_pitch: distance of its pixels.
        offset: of the mask's centre from the panel's.
        flip: mirror the mask first.
        rotate: then turn it counter-clockwise.
        suffix: kind of files.
    """

    bits: Annotated[int, Unit("B", "", 1, 10)] | None = None
    wavelength: Metres = 530e-9
    phase_range: Annotated[float, Unit("RAD", "radians", 0, above=True)] | None = None
    response: File | None = None
    panel: Size | None = None
    panel_pitch: Metres = 8e-6
    offset: Annotated[tuple[int, int], Unit("RIGHT DOWN", "panel pixels")] = (0, 0)
    flip: Annotated[str, one_of(FLIPS)] = "none"
    rotate: Annotated[int, one_of(ROTATIONS)] = 0
    suffix: Annotated[str, one_of((".png", ".tif", ".tiff"))] = ".png"


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Timing (frames).

    Args:
        exposure: of a capture. None: as saved, or 0.1.
        switching_time: of a swap. None: as saved, or 0.
        dwell: share of each mask. None: as saved, or equal.
        cyclic: the swap back to the first also falls into the exposure.
    """

    exposure: Seconds | None = None
    switching_time: Seconds | None = None
    dwell: tuple[Annotated[float, Unit("SHARE", "", 0)], ...] = ()
    cyclic: bool = False


@dataclass(frozen=True, kw_only=True)
class ShowMasks:
    """List the masks of a file.

    Args:
        masks: heights in metres (.npy, K x rows x columns), a camera's state_dict, or a checkpoint (.safetensors).
        material: what turns height into phase. None: as saved, or constant, index 1.5 at every wavelength.
    """

    masks: MasksFile
    material: MaterialName | None = None

    def run(self) -> None:
        """Print the masks of a file with their size and heights."""
        from kornia_tidy.cli.commands.report import tell

        saved = _saved(self.masks, self.material)
        heights = saved.heights
        tell("masks", _in_words(heights))
        tell("material", saved.material.name)
        for k, one in enumerate(heights):
            low, high = one.aminmax()
            rms = float(one.std(correction=0))
            tell(f"mask {k}", f"{float(low) * 1e9:.1f} to {float(high) * 1e9:.1f} nm, RMS {rms * 1e9:.1f} nm")
        if saved.dwell is not None:
            tell("dwell", " ".join(f"{share:.4f}" for share in saved.dwell))


@dataclass(frozen=True, kw_only=True)
class ExportMasks:
    r"""Write SLM frames or heights.

    A state_dict tells the masks' family, constraint and material, and the modulator; its
    grey levels, dwell and switching times are the defaults of frames. One of only masks
    (phase in radians at 530 nm) lacks them. The name of OUT gives the format:
      a folder  one frame per mask for the panel of a phase modulator (PNG or TIFF),
                timing.csv, and frames.json with the settings needed to read them
                back; up to 8 bits in 8-bit files, 9 and 10 in the least
                significant bits of 16-bit files
      x.npy     heights in metres
    Files are written atomically, and frames are read back and compared.

    Args:
        masks: heights in metres (.npy, K x rows x columns), a camera's state_dict, or a checkpoint (.safetensors).
        output: a folder, or x.npy.
        material: what turns height into phase. None: as saved, or constant, index 1.5 at every wavelength.
        force: replace earlier files.
        pupil_radius: of the pupil on the panel; the mask is 2.3 radii wide. None: the largest with a whole number of
            panel pixels per mask pixel.
        panel: of frames.
        timing: of frames.

    Examples:
        Frames for a 1920 x 1200 panel, seen through a mirror:
          kornia-tidy masks export camera.safetensors -o slm --flip left-right

        A 10-bit panel with a measured response and swaps of 4 ms:
          kornia-tidy masks export heights.npy -o slm --bits 10 --response lut.csv \
              --exposure 0.1 --switching-time 0.004 --wavelength 532e-9
    """

    masks: MasksFile
    output: Annotated[str, Unit("OUT")]
    material: MaterialName | None = None
    force: bool = False
    pupil_radius: Metres | None = None
    panel: Panel = field(default_factory=Panel)
    timing: Timing = field(default_factory=Timing)

    def run(self) -> None:
        """Export masks as SLM frames or heights, by the name of the output."""
        from kornia_tidy.checks import check_choice
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.mask_export.mask_files import write_heights

        kind = Path(self.output).suffix.lower()
        check_choice("the suffix of what to write", kind, ("", ".npy"))
        _check_absent(self.output, self.force, self.masks, folder=not kind)
        saved = _saved(self.masks, self.material)
        tell("masks", _in_words(saved.heights))
        if kind == ".npy":
            write_heights(self.output, saved.heights)
        else:
            self._frames(saved)
        tell("wrote", self.output)

    def _frames(self, saved: SavedMasks) -> None:
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.mask_export.frame_files import read_slm_frames, write_slm_frames
        from kornia_tidy.lab.mask_export.placement import PanelPlacement
        from kornia_tidy.lab.mask_export.response_file import read_response
        from kornia_tidy.lab.mask_export.slm_frames import SLMFrames
        from kornia_tidy.masks.base import metres_to_radians

        asked, timing, heights = self.panel, self.timing, saved.heights
        response = None if asked.response is None else read_response(asked.response, asked.bits or 8)
        levels = saved.levels(asked.wavelength, asked.bits, asked.phase_range, response)
        times = saved.times(timing.exposure, timing.switching_time, timing.dwell, timing.cyclic)
        height, width = asked.panel or (1200, 1920)
        placement = PanelPlacement(
            (height, width), asked.panel_pitch, self.pupil_radius, asked.offset, asked.flip, asked.rotate
        )
        frames = SLMFrames.of(heights, levels, asked.wavelength, saved.material)
        write_slm_frames(self.output, frames, placement, times, asked.suffix, replace=self.force)
        size = (heights.shape[1], heights.shape[2])
        scale = placement.scale(size)
        uneven = "" if scale == round(scale) else ", so that blocks differ by one"
        tell("panel", f"{width} x {height} px, {scale:.6g} a mask pixel{uneven}")
        tell("pupil", f"radius {placement.radius(size) * 1e3:.4g} mm on the panel")
        tell("frames", frames.in_words())
        # By the panel's phases and the masks themselves, not by the sidecar's description.
        wanted = heights * metres_to_radians(saved.material, asked.wavelength)
        error, share = read_slm_frames(self.output).phase_error(wanted, levels.levels)
        tell("check", f"read back, phase differs by up to {error:.3g} rad, {share / 2:.3f} grey levels, 0.5 allowed")
        if share > 1:
            raise ValueError(f"{self.output} does not hold the masks: phase differs by {error:.3g} rad")


@dataclass(frozen=True, kw_only=True)
class ImportMasks:
    """Read SLM frames back and check them.

    Every pixel is checked. The masks' heights are written if OUT is given.

    Args:
        frames: folder that export wrote.
        output: x.npy (metres) or x.safetensors (masks.phase). None: nothing is written.
        shown: heights as shown by the panel, wrapped to one wave, not with the whole waves restored.
        material: what turns height into phase. None: as saved, or constant, index 1.5 at every wavelength.
        force: replace the output.
    """

    frames: Annotated[str, Argument("FOLDER")]
    output: Annotated[str, Unit("OUT")] | None = None
    shown: bool = False
    material: MaterialName | None = None
    force: bool = False

    def run(self) -> None:
        """Import SLM frames, check them, and write their heights."""
        from kornia_tidy.checks import check_choice
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.mask_export.frame_files import read_slm_frames
        from kornia_tidy.lab.mask_export.mask_files import write_heights

        if self.output is not None:
            check_choice("the suffix of what to write", Path(self.output).suffix.lower(), (".npy", ".safetensors"))
            _check_absent(self.output, self.force)
        frames = read_slm_frames(self.frames)
        heights = frames.heights_shown() if self.shown else frames.heights()
        tell("masks", _in_words(heights))
        tell("frames", frames.in_words())
        if self.output is not None:
            write_heights(self.output, heights, _material(self.material))
            tell("wrote", self.output)


def _material(name: str | None) -> Material | None:
    """Return a material by its name."""
    from kornia_tidy.optics import materials

    if name is None:
        return None
    known = (materials.constant_index(1.5), materials.FUSED_SILICA, materials.PMMA, materials.PDMS, materials.NOA61)
    return dict(zip(MATERIALS, known, strict=True))[name]


def _saved(path: str, name: str | None) -> SavedMasks:
    """Return the masks of a file and their description."""
    from kornia_tidy.files import error_prefix
    from kornia_tidy.lab.mask_export.mask_files import SavedMasks, masks_in_state, read_heights
    from kornia_tidy.reconstruction.trained import camera_state

    if Path(path).suffix.lower() != ".safetensors":
        material = _material(name or "constant")
        assert material is not None
        return SavedMasks(read_heights(path), material)
    state = camera_state(path)
    with error_prefix(f"cannot read {path}", TypeError):
        return masks_in_state(state, _material(name))


def _check_absent(path: str, force: bool, source: str | None = None, folder: bool = False) -> None:
    """Check before any work that the output may be written.

    Raises:
        FileExistsError: if it exists and is not to be replaced.
        FileNotFoundError: if its parent folder does not exist.
    """
    from kornia_tidy.lab.mask_export.frame_files import check_replaceable

    target = Path(path)
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {target.parent}")
    if source is not None and target.exists() and Path(source).exists() and target.samefile(source):
        raise FileExistsError(f"cannot write {path}: it is the input")
    if target.exists() and not force:
        raise FileExistsError(f"cannot write {path}: it exists, and --force was not given")
    if folder:
        check_replaceable(path, force)


def _in_words(heights: Tensor) -> str:
    count, rows, columns = heights.shape
    low, high = heights.aminmax()
    return f"{count} of {rows}x{columns} pixels, heights {float(low) * 1e9:.1f} to {float(high) * 1e9:.1f} nm"
