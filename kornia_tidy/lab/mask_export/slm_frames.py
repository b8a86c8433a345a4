"""SLM frames: heights of masks converted to the grey levels of a panel, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.masks.base import HEIGHTS, PhaseMasks, metres_to_radians
from kornia_tidy.modulator.phase_panel import GreyLevels, nearest_level
from kornia_tidy.optics.materials import Material, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

_WAVE = 2 * math.pi


@dataclass(frozen=True, eq=False)
class SLMFrames:
    r"""Grey levels of a panel for K masks, with the parameters that convert them back to heights.

    A height h has the phase :math:`\phi = 2 \pi h (n(\lambda) - 1) / \lambda` at the working wavelength λ. The panel
    shows the level with the nearest phase :math:`\phi_g` modulo 2π, so :math:`\phi \approx \phi_g + 2 \pi t`. The t
    whole waves have no effect at λ, and the panel does not show them.

    Args:
        grey: g, (K, rows, columns) int64.
        turns: t, (K, rows, columns) int64.
        level_phases: :math:`\phi_g`, (2^b,) radians at the working wavelength, float64.
        wavelength: λ in metres.
        radians_per_metre: :math:`2 \pi (n(\lambda) - 1) / \lambda`.

    Example:
        >>> frames = SLMFrames.of(torch.tensor([[[0.0, 265e-9, 1.06e-6]]]).double(), GreyLevels(8))
        >>> frames.grey.tolist(), frames.turns.tolist()
        ([[[0, 64, 0]]], [[[0, 0, 1]]])
        >>> (frames.heights() * 1e9).round().tolist(), (frames.heights_shown() * 1e9).round().tolist()
        ([[[0.0, 265.0, 1060.0]]], [[[0.0, 265.0, 0.0]]])
    """

    grey: Tensor
    turns: Tensor
    level_phases: Tensor
    wavelength: float
    radians_per_metre: float

    @classmethod
    def of(
        cls,
        masks: PhaseMasks | Tensor,
        panel: GreyLevels,
        wavelength: float = REFERENCE_WAVELENGTH,
        material: Material | None = None,
    ) -> SLMFrames:
        """Return the frames that show given masks on a panel.

        Args:
            masks: phase masks of any family, or heights in metres (K, rows, columns).
            panel: grey levels of the panel. Their phases are taken to be those at ``wavelength``, at which panels are
                calibrated, and not those at 530 nm.
            wavelength: working wavelength in metres, at which the frames have the phase of the masks.
            material: material of the heights. Default: that of the masks; index 1.5 for heights without material.

        Raises:
            TypeError: if heights are not a floating-point tensor.
            ValueError: if heights have another shape or are not finite, or the material's index at the wavelength is
                not known.
        """
        if isinstance(masks, PhaseMasks):
            material = masks.material if material is None else material
            heights = masks.phase.detach().cpu().double() / metres_to_radians(masks.material)
        else:
            heights = checked_heights(masks)
        per_metre = metres_to_radians(constant_index(1.5) if material is None else material, wavelength)
        wanted = heights * per_metre
        grey = nearest_level(wanted, panel.levels)
        turns = ((wanted - panel.levels[grey]) / _WAVE).round().long()
        return cls(grey, turns, panel.levels.clone(), wavelength, per_metre)

    @property
    def bits(self) -> int:
        """Number of bits of a grey level."""
        return (len(self.level_phases) - 1).bit_length()

    @property
    def background(self) -> int:
        """Grey level nearest to phase 0, for panel pixels outside the mask."""
        return int(nearest_level(torch.zeros(1, dtype=torch.float64), self.level_phases))

    def in_words(self) -> str:
        """Return number, bits and phases of the frames, and how much of them is wrapped."""
        beyond = float((self.turns != 0).double().mean())
        wrapped = f", {beyond:.1%} of the pixels wrapped by whole waves" if beyond else ""
        return (
            f"{len(self.grey)} of {self.bits} bits, {float(self.level_phases.min()):.3f} to "
            f"{float(self.level_phases.max()):.3f} rad at {self.wavelength * 1e9:g} nm{wrapped}"
        )

    def heights(self) -> Tensor:
        """Return the heights of the masks in metres, (K, rows, columns) float64, accurate to :meth:`largest_error`."""
        return (self.level_phases[self.grey] + _WAVE * self.turns.double()) / self.radians_per_metre

    def heights_shown(self) -> Tensor:
        """Return the heights that the panel really shows, without the whole waves, for PSFs at other wavelengths."""
        return self.level_phases[self.grey] / self.radians_per_metre

    def largest_error(self) -> float:
        """Return the largest quantisation error of phase, in radians at the working wavelength.

        It is half of the widest gap between levels, modulo 2π: π / 2^b for a range of 2π.

        Example:
            >>> frames = SLMFrames.of(torch.zeros(1, 3, 3), GreyLevels(3, phase_range=math.pi))
            >>> round(frames.largest_error() / math.pi, 4)  # levels from 0 to 7/8 pi leave a gap of 9/8 pi
            0.5625
        """
        ascending = self.level_phases.remainder(_WAVE).sort().values
        return float(torch.cat([ascending, ascending[:1] + _WAVE]).diff().max()) / 2

    def phase_error(self, wanted: Tensor, levels: Tensor) -> tuple[float, float]:
        """Return how far the phase shown by a panel is from the wanted phase of the masks.

        Args:
            wanted: (K, rows, columns) radians at the working wavelength.
            levels: (2^b,) radians of the panel's grey levels, from its data or its measurement.

        Returns:
            The largest difference in radians, and the largest in units of half the distance to the next phase of a
            level, modulo 2π. A phase that no other level shows better is at 1 or less.

        Example:
            >>> wanted = torch.tensor([[[0.0, 3.2, 6.2]]]).double()
            >>> frames = SLMFrames.of(wanted * 530e-9 / math.pi, GreyLevels(2))
            >>> [round(number, 2) for number in frames.phase_error(wanted, GreyLevels(2).levels)]
            [0.08, 0.11]
        """
        phases, place = levels.double().remainder(_WAVE).unique(return_inverse=True)
        above = torch.cat([phases, phases[:1] + _WAVE]).diff()
        half_gap = torch.maximum(above, above.roll(1))[place][self.grey] / 2
        apart = (levels.double()[self.grey] + _WAVE * self.turns.double() - wanted.double()).abs()
        return float(apart.max()), float((apart / (half_gap + 1e-9)).max())


def checked_heights(heights: Tensor) -> Tensor:
    """Check heights and return them as float64 on the CPU.

    Args:
        heights: (K, rows, columns) metres.

    Raises:
        TypeError: if heights are not a floating-point tensor.
        ValueError: if heights have another shape, are not finite, or are no metres.
    """
    check_float_tensor("heights", heights, 3, "(K, rows, columns)")
    if not heights.numel() or not bool(torch.isfinite(heights).all()):
        raise ValueError(f"heights must be finite metres, at least one, got a map of shape {tuple(heights.shape)}")
    if (highest := float(heights.detach().abs().max())) > HEIGHTS[1]:
        raise ValueError(f"heights must be metres within {HEIGHTS[1]:g} (1 um is 1e-6), got {highest:g}")
    return heights.detach().cpu().double()
