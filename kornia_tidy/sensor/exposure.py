"""Exposure: the light that an aperture admits in a given time, as a sensor that a white pixel just saturates."""

from __future__ import annotations

import math

from kornia_tidy.checks import check_metres, check_positive
from kornia_tidy.optics.thin_lens import PITCHES
from kornia_tidy.sensor.sensor import SensorNoise

# Electrons for each square metre of a pixel: 10,500 on 3.45 um pixels, as the EMVA 1288 data sheets of cameras with a
# Sony IMX250 have, and the 57,000 on 8 um of the default design. Back-illuminated sensors hold two to three times that.
FULL_WELL_DENSITY = 57_000 / 8e-6**2


def full_well_of(pixel_pitch: float) -> float:
    """Return the full well of a common pixel: electrons in proportion to its area.

    Args:
        pixel_pitch: in metres.

    Source: EMVA 1288 data sheets of cameras with a Sony IMX250: 10,500 electrons on pixels of 3.45 um.

    Example:
        >>> round(full_well_of(3.45e-6), -2)
        10600.0
    """
    check_metres("pixel_pitch", pixel_pitch, *PITCHES, "8 um is 8e-6")
    return FULL_WELL_DENSITY * pixel_pitch**2


def electrons_at(f_number: float, electrons: float, reference_f_number: float) -> float:
    r"""Return the electrons that white gives at an f-number, for the same exposure time as at a reference f-number.

    .. math:: n = n_0 \, (N_0 / N)^2

    Args:
        f_number: f-number N of the camera.
        electrons: electrons n_0 of a white pixel at the reference f-number.
        reference_f_number: f-number N_0 at which they were counted.

    Returns:
        Electrons of a white pixel.

    Raises:
        ValueError: if a value is not positive.

    Source: irradiance of an image is proportional to 1 / N^2, e.g. Hecht, Optics, section 5.3.

    Example:
        >>> electrons_at(35.2, electrons=57000, reference_f_number=17.6)
        14250.0
    """
    check_positive("f_number", f_number)
    check_positive("electrons", electrons)
    check_positive("reference_f_number", reference_f_number)
    return electrons * (reference_f_number / f_number) ** 2


def exposed_sensor(
    f_number: float,
    electrons: float,
    reference_f_number: float,
    read_noise_electrons: float = 2.4,
    full_well: float = math.inf,
) -> SensorNoise:
    """Return the sensor that compares cameras of different f-numbers at equal exposure time.

    Its gain makes white 1.0 at every f-number; a smaller aperture collects fewer electrons, so that its image is
    noisier. Where white would exceed the full well, the exposure is shorter, so that white just fills it.

    Args:
        f_number: f-number of the camera.
        electrons: electrons of a white pixel at the reference f-number.
        reference_f_number: f-number at which they were counted.
        read_noise_electrons: standard deviation of the read noise, in electrons; at every f-number the same.
        full_well: capacity of a pixel in electrons, see :func:`full_well_of`.

    Returns:
        Sensor with shot and read noise, clipped to [0, 1], without quantisation.

    Raises:
        ValueError: if a value is out of its range.

    Example:
        >>> exposed_sensor(50, electrons=57000, reference_f_number=17.6)
        SensorNoise(read noise 0.000339822 of full scale, full well 7062.53 electrons, clipped to [0, 1])
    """
    white = min(electrons_at(f_number, electrons, reference_f_number), full_well)
    return SensorNoise(read_noise_electrons / white, full_well=white)
