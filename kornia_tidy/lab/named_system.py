"""The system that restores captures, by its name or file: shipped, trained, in closed form, or for any camera."""

from __future__ import annotations

from pathlib import Path

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.choices import PRETRAINED, REPLACED
from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs
from kornia_tidy.lab.measured import closed_form_system, with_measurements
from kornia_tidy.reconstruction.camera_system import any_camera_system, saved_system
from kornia_tidy.reconstruction.head_names import ANY_CAMERA, CLOSED_FORMS
from kornia_tidy.reconstruction.pretrained import FOLDER, check_shipped
from kornia_tidy.reconstruction.trained import TrainedSystem
from kornia_tidy.sensor.sensor import SensorNoise


def head_file(head: str) -> Path:
    """Return the file of a network, by the name of one that comes with the library or by its own.

    Example:
        >>> head_file("edof-5").name
        'edof-5.safetensors'
    """
    if head in PRETRAINED:
        return FOLDER / f"{head}.safetensors"
    if head in CLOSED_FORMS:
        raise ValueError(f"the head {head!r} needs the PSFs of a camera: give --psfs, or --masks or its file")
    if head in REPLACED:
        check_shipped(head)
    if not Path(head).exists():
        raise FileNotFoundError(
            f"a system is {', '.join(PRETRAINED)}, a checkpoint, or a saved camera: there is no file {head}"
        )
    return Path(head)


def load_system(
    head: str | None, psfs: str | None, sensor: SensorNoise | None, optics: TiDyOptics | None = None
) -> TrainedSystem:
    """Return the system that is named, behind the camera that was measured or is given.

    Args:
        head: name of a shipped system or of a closed form, a checkpoint, or the file of a camera, whose captures the
            network for any camera restores. None: that network, by the PSFs of the camera.
        psfs: file of measured PSFs.
        sensor: measured noise. None: the system's own.
        optics: a camera, whose captures a closed form or the network for any camera restores, instead of ``psfs``.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if neither a system nor PSFs are given, a file is of another kind, or the PSFs are not of the
            system's lens and depths.
    """
    if head is None and psfs is None and optics is None:
        raise ValueError(
            f"a system is needed: one of {', '.join(PRETRAINED)}, a checkpoint, a saved camera, --psfs or --masks"
        )
    if optics is not None:
        return any_camera_system(optics, sensor, head or ANY_CAMERA)
    measured = None if psfs is None else MeasuredPSFs.load(psfs)
    if measured is not None and (head is None or head in CLOSED_FORMS):
        return closed_form_system(measured, sensor, head or ANY_CAMERA)
    assert head is not None
    system = saved_system(head_file(head), sensor)
    return system if measured is None and sensor is None else with_measurements(system, measured, sensor)
