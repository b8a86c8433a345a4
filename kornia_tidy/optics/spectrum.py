"""Spectral sampling: the wavelengths at which PSFs are computed, and their weights in each colour channel."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from kornia_tidy.checks import check_choice, check_number
from kornia_tidy.search_path import import_installed

REFERENCE_WAVELENGTH = 530e-9  # m; defocus and mask phase are quoted at this wavelength throughout

SHORTEST, LONGEST = 100e-9, 20e-6  # m; from vacuum ultraviolet to thermal infrared
VISIBLE = (400e-9, 700e-9)  # m; passband of a camera's filters


def check_wavelength(name: str, wavelength: float) -> None:
    """Raise ``ValueError`` unless a wavelength in metres is between 100 nm and 20 um."""
    check_number(name, wavelength, "metres")
    if not SHORTEST <= wavelength <= LONGEST:
        allowed = f"metres between {SHORTEST:g} and {LONGEST:g} (530 nm is 530e-9)"
        raise ValueError(f"{name} must be {allowed}, got {wavelength}")


@dataclass(frozen=True)
class Spectrum:
    r"""Wavelength samples shared by all channels, and their weights. It is plain data that can be hashed and pickled.

    The PSF of channel c is the weighted mean of the PSFs at the wavelengths:

    .. math:: h_c = \sum_\lambda w_{c\lambda} h_\lambda \Big/ \sum_\lambda w_{c\lambda}

    Args:
        wavelengths: the W samples in metres.
        weights: C rows of W numbers, the response of channel c at each wavelength, in any common unit.
        basis: C rows of W numbers, the reflectance spectrum of a scene point with the value 1 in one channel and 0 in
            the others. None: every scene point reflects all wavelengths of a channel equally. See
            :func:`smoothest_reflectances`.

    Raises:
        ValueError: if a wavelength is not between 100 nm and 20 µm, a weight is negative or not finite, a row is not
            as long as ``wavelengths``, all weights of a channel are zero, or a basis spectrum does not have the value
            1 in its own channel and 0 in the others.

    Example:
        >>> Spectrum((500e-9, 600e-9), ((1, 3),)).channel_weights
        ((0.25, 0.75),)
        >>> Spectrum((530,), ((1,),))
        Traceback (most recent call last):
        ValueError: wavelengths must be metres between 1e-07 and 2e-05 (530 nm is 530e-9), got 530.0
    """

    wavelengths: tuple[float, ...]
    weights: tuple[tuple[float, ...], ...]
    basis: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        # Lists and NumPy rows become tuples of floats, so that a spectrum can always be hashed.
        object.__setattr__(self, "wavelengths", _floats(self.wavelengths))
        object.__setattr__(self, "weights", tuple(_floats(row) for row in self.weights))
        if not self.wavelengths or not self.weights:
            raise ValueError("a spectrum must have at least one wavelength and one channel, got none")
        for wavelength in self.wavelengths:
            check_wavelength("wavelengths", wavelength)
        for channel, row in enumerate(self.weights):
            if len(row) != len(self.wavelengths):
                raise ValueError(
                    f"weights of channel {channel} must have one number for each of the {len(self.wavelengths)} "
                    f"wavelengths, got {len(row)}"
                )
            for weight in row:
                if not 0 <= weight < math.inf:
                    raise ValueError(f"weights must be finite and not negative, got {weight} in channel {channel}")
            if not sum(row) > 0:
                raise ValueError(f"weights of channel {channel} must have a positive sum, got {sum(row)}")
        if self.basis is not None:
            object.__setattr__(self, "basis", tuple(_floats(row) for row in self.basis))
            shape = (len(self.weights), len(self.wavelengths))
            if (len(self.basis), *{len(row) for row in self.basis}) != shape:
                raise ValueError(f"basis must have shape {shape} as the weights have, got {np.shape(self.basis)}")
            values = np.array(self.channel_weights) @ np.array(self.basis).T
            if not np.allclose(values, np.eye(shape[0]), rtol=0, atol=1e-6):
                raise ValueError(f"basis must give 1 in its own channel and 0 in the others, got {values.tolist()}")

    @property
    def channel_weights(self) -> tuple[tuple[float, ...], ...]:
        """The weights divided by their sum in each channel, (C, W): every row adds up to one."""
        return tuple(tuple(weight / sum(row) for weight in row) for row in self.weights)

    @property
    def plane_weights(self) -> tuple[tuple[float, ...], ...]:
        r"""Wavelength weights of the PSF planes that rendering needs, (C B, W), ordered by channel, then by basis.

        The PSF of channel c and basis spectrum b is :math:`h_{cb} = \sum_\lambda w_{c\lambda} R_{b\lambda} h_\lambda`.
        Without a basis these are the channel weights, (C, W).
        """
        rows = self.channel_weights
        if self.basis is None:
            return rows
        return tuple(tuple(w * r for w, r in zip(row, basis, strict=True)) for row in rows for basis in self.basis)

    def flat(self) -> Spectrum:
        """Return this spectrum without its reflectance basis, for scenes that reflect all wavelengths equally."""
        return Spectrum(self.wavelengths, self.weights)

    @classmethod
    def rgb(cls) -> Spectrum:
        """Return the spectrum of the papers, one wavelength a channel: 610, 530 and 470 nm for red, green and blue.

        Source: Wu et al., PhaseCam3D, ICCP 2019; Shah et al., TiDy-PSFs, ICCV 2023.

        Example:
            >>> Spectrum.rgb().wavelengths
            (6.1e-07, 5.3e-07, 4.7e-07)
        """
        return cls((610e-9, REFERENCE_WAVELENGTH, 470e-9), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))

    @classmethod
    def monochrome(cls, wavelength: float = REFERENCE_WAVELENGTH) -> Spectrum:
        """Return a single channel at a single wavelength in metres."""
        return cls((wavelength,), ((1.0,),))


def camera_spectrum(
    camera: str = "Nikon 5100 (NPL)", illuminant: str = "D65", samples: int = 7, reflectance: bool = False
) -> Spectrum:
    r"""Return the spectral weights of a real camera under an illuminant, sampled over 400-700 nm.

    The range is cut into equal slices S. Each sample lies in the middle of a slice and carries the mean over it:

    .. math:: w_{ci} = \frac{1}{|S_i|} \int_{S_i} s_c(\lambda)\, E(\lambda)\, d\lambda

    with the measured sensitivity s and the illuminant E. Narrow lamp lines between the samples are thus also counted.

    Args:
        camera: name of a camera in colour-science, "Nikon 5100 (NPL)" or "Sigma SDMerill (NPL)".
        illuminant: name of an illuminant in colour-science, such as "D65", "A" or "FL2".
        samples: number of wavelengths W. For the Nikon, D65 and a flat mask, 7 give the on-axis PSF to 1.3 % on
            average over defocus from -20 to 20 rad, and 16 give it to 0.24 %.
        reflectance: give each colour of a scene a reflectance spectrum (:func:`smoothest_reflectances`), and with it
            its own PSFs. On a real scene (Aloe, five random masks, captures with values in [0, 1]) this changes the
            capture by 3.5e-4 root mean square with windows of 23 px and by 7.6e-4 with 65 px. The change from
            ``Spectrum.rgb()`` to these wavelengths is as large. Rendering takes 2.3 to 3.1 times as long, because it
            has nine PSF planes instead of three.

    Returns:
        W wavelengths shared by the channels red, green and blue; weights in the illuminant's unit.

    Raises:
        ValueError: if the camera or illuminant is unknown (the message lists the known ones), or ``samples`` is below
            1, or below 3 with ``reflectance``.

    Convention:
        - A sensitivity is zero beyond the range in which it was measured (Sigma: 400-680 nm).

    Source: Darrodi et al., J. Opt. Soc. Am. A 32, 381 (2015), and CIE illuminants, from the tables of colour-science.

    Example:
        >>> spectrum = camera_spectrum(samples=3)
        >>> [round(wavelength * 1e9) for wavelength in spectrum.wavelengths]
        [450, 550, 650]
        >>> [round(weight, 2) for weight in spectrum.channel_weights[1]]
        [0.26, 0.71, 0.04]
    """
    if samples != int(samples) or samples < 1:
        raise ValueError(f"samples must be a whole number of at least 1, got {samples}")
    wavelengths = _slice_middles(int(samples))
    steps = 100  # per slice: finer than the tables' 5 nm
    grid = _slice_middles(int(samples) * steps)
    with warnings.catch_warnings(), np.printoptions():  # importing colour warns, and sets NumPy's print options
        warnings.simplefilter("ignore")
        colour = import_installed("colour")  # takes two seconds, which only this function needs
        check_choice("camera", camera, list(colour.MSDS_CAMERA_SENSITIVITIES))
        check_choice("illuminant", illuminant, list(colour.SDS_ILLUMINANTS))
        sensitivity = colour.MSDS_CAMERA_SENSITIVITIES[camera]
        light = colour.SDS_ILLUMINANTS[illuminant]
    lamp = _resample(grid, light.wavelengths, light.values)
    responses = np.stack([_resample(grid, sensitivity.wavelengths, column) for column in sensitivity.values.T]) * lamp
    weights = responses.reshape(len(responses), -1, steps).mean(axis=-1)
    spectrum = Spectrum(tuple(wavelengths), tuple(weights))
    if not reflectance:
        return spectrum
    return replace(spectrum, basis=tuple(smoothest_reflectances(np.array(spectrum.channel_weights))))


def smoothest_reflectances(channel_weights: np.ndarray) -> np.ndarray:
    r"""Return the smoothest reflectance spectra that a camera records as pure red, green and blue.

    .. math:: R_b = \arg\min_R \sum_i (R_{i+1} - R_i)^2 \quad \text{with} \quad \sum_i w_{ci} R_i = \delta_{cb}

    A scene point of colour (r, g, b) is given the reflectance r R_r + g R_g + b R_b, the smoothest one of that colour.
    Grey gets a flat spectrum. The channels overlap, so no real surface is as saturated as a pure channel, and R is
    negative at some wavelengths. In the Aloe scene, with its sRGB taken for the camera's colours, 3 % of all values
    over pixels and wavelengths are negative. The camera's colours are reproduced exactly all the same.

    Args:
        channel_weights: w, (C, W), rows that add up to one, on an even grid of wavelengths.

    Returns:
        C reflectance spectra, (C, W). They add up to one at each wavelength.

    Raises:
        ValueError: if there are fewer wavelengths than channels.

    Source: van Trigt, Smoothest reflectance functions, J. Opt. Soc. Am. A 7, 1891 (1990).

    Example:
        >>> smoothest_reflectances(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])).round(6) + 0.0
        array([[0., 0., 1.],
               [0., 1., 0.],
               [1., 0., 0.]])
    """
    channels, samples = channel_weights.shape
    if samples < channels:
        raise ValueError(f"samples must be at least {channels} for reflectances of {channels} channels, got {samples}")
    difference = np.diff(np.eye(samples), axis=0)
    # Least squares under equality constraints, by Lagrange multipliers.
    smoothness = difference.T @ difference
    system = np.block([[smoothness, channel_weights.T], [channel_weights, np.zeros((channels, channels))]])
    target = np.concatenate([np.zeros((samples, channels)), np.eye(channels)])
    return np.linalg.solve(system, target)[:samples].T


def _slice_middles(count: int) -> np.ndarray:
    """Return the middles of equal slices of the visible range, in metres."""
    shortest, longest = VISIBLE
    return shortest + (np.arange(count) + 0.5) * (longest - shortest) / count


def _resample(grid: np.ndarray, nanometres: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a table's values on a grid in metres, linear between entries and zero beyond them."""
    return np.interp(grid, nanometres * 1e-9, values, left=0, right=0)


def _floats(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
