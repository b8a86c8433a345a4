"""Systems of a camera that was measured: its PSFs and its noise in the settings, and the closed form to restore with.

A laboratory measures the finished camera, whatever was designed. Measurements replace computed values: the
PSFs of masks and lens, and the noise of the sensor.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from kornia_tidy.checks import check_choice, check_part
from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs
from kornia_tidy.lab.capture_file import CaptureLight
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.closed_form import ClosedForm
from kornia_tidy.reconstruction.head_names import ANY_CAMERA, CLOSED_FORMS
from kornia_tidy.reconstruction.layered_joint import LayeredJointHead
from kornia_tidy.reconstruction.refocused import Refocused
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.tiled import shared_copy
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, build_optics, fix_window, update_psfs
from kornia_tidy.sensor.sensor import SensorNoise

DEFOCUS_BEYOND = 2.0  # rad; a network may be for depths that the measured PSFs miss by so little
SAME_LENS = 0.05  # relative difference of lengths; a lens that is built differs from its design


def measured_settings(psfs: MeasuredPSFs) -> dict[str, Any]:
    """Return the settings of a camera with measured PSFs, by name.

    Args:
        psfs: the measurement, with its lens.

    Returns:
        Lens, range of depth, window and ``masks=0`` as settings of
        :class:`~kornia_tidy.reconstruction.settings.SystemSettings`.

    Raises:
        ValueError: if the lens is unknown.
    """
    camera = psfs.known_camera()
    return {
        "measured": True,
        "masks": 0,
        "focal_length": camera.focal_length,
        "pixel_pitch": camera.pixel_pitch,
        "depth_range": camera.depth_range,
        "f_number": camera.f_number,
        "focus_distance": float(camera.focus_distance),
        "window": psfs.bank.window,
    }


def noise_settings(sensor: SensorNoise) -> dict[str, Any]:
    """Return the noise of a sensor as settings, by name.

    Example:
        >>> noise_settings(SensorNoise(0.01))
        {'sigma': 0.01, 'full_well': None, 'bits': None}
    """
    return {name: getattr(sensor, name) for name in ("sigma", "full_well", "bits")}


@torch.no_grad()
def closed_form_system(psfs: MeasuredPSFs, sensor: SensorNoise | None = None, head: str = ANY_CAMERA) -> TrainedSystem:
    """Return a camera that was measured with what restores its captures without training.

    Args:
        psfs: the measurement, of one or three colours.
        sensor: its noise, such as
            :meth:`~kornia_tidy.lab.calibration.noise.photon_transfer.PhotonTransfer.sensor_noise`. Default: read noise
            of 0.01.
        head: one of :data:`~kornia_tidy.reconstruction.heads.CLOSED_FORMS`.

    Raises:
        ValueError: if the lens is unknown, there are other numbers of colours, or no such closed form.

    Example:
        >>> lens, distances = ThinLensCamera(depth_range=(0.5, 0.8)), torch.tensor([0.8, 0.5])
        >>> from kornia_tidy import PSFBank
        >>> bank = PSFBank.from_measured(torch.rand(2, 3, 5, 5), lens.defocus(distances))
        >>> system = closed_form_system(MeasuredPSFs(bank, torch.zeros(2, 3, 5, 5), distances, camera=lens))
        >>> system.head(torch.rand(1, 3, 24, 32)).shape
        torch.Size([1, 3, 24, 32])
    """
    check_choice("head", head, CLOSED_FORMS)
    settings = SystemSettings(head=head, **measured_settings(psfs), **noise_settings(sensor or SensorNoise()))
    optics, network = build_optics(settings, psfs.bank), build_head(settings)
    update_psfs(network, optics)
    return TrainedSystem(optics.eval(), network.eval(), settings, 0)


@torch.no_grad()
def with_measurements(
    system: TrainedSystem, psfs: MeasuredPSFs | None = None, sensor: SensorNoise | None = None
) -> TrainedSystem:
    """Return a trained system for the camera that was measured: its network uses the measured PSFs and noise.

    Args:
        system: camera and network, which are not changed; masks and weights are shared.
        psfs: that replace those of the system's masks. None: they stay.
        sensor: that replaces the system's. None: it stays.

    Raises:
        ValueError: if the PSFs were measured with another lens, or reach over less than the system's depths.
    """
    optics, settings = system.optics.with_fidelity(system.optics.fidelity), system.settings  # with the same parts
    if psfs is not None:
        lens: Any = optics.camera
        check_part("the system's camera", lens, ThinLensCamera, "a ThinLensCamera, whose depths are in metres")
        _check_lens(psfs.known_camera(), lens)
        _check_range(psfs, lens)
        optics = fix_window(optics.with_bank(psfs.bank))
        settings = settings.replace(measured=True, window=psfs.bank.window)
    if sensor is not None:
        optics.sensor = sensor
        settings = settings.replace(**noise_settings(sensor))
    head = shared_copy(system.head)
    update_psfs(head, optics)
    return system._replace(optics=optics, head=head, settings=settings)


def takes_psfs(head: nn.Module) -> bool:
    """Return whether a network deconvolves captures with the PSFs of its camera."""
    return any(isinstance(module, ClosedForm | LayeredJointHead | Refocused) for module in head.modules())


def check_capture(system: TrainedSystem, path: str, capture: CaptureLight) -> None:
    """Check that a capture has the colours of measured PSFs, and the noise that a closed form needs.

    Args:
        system: of a camera that was measured, see :func:`closed_form_system` and :func:`with_measurements`, or given
            by lens and masks.
        path: of the capture, for the error.
        capture: as it was read.

    Raises:
        ValueError: if it has other colours than the PSFs, or a closed form lacks its noise.
    """
    measured, colors = system.optics.psf_model.measured, len(capture.light)
    if measured is not None and colors != (channels := measured.psfs.shape[-3]):
        raise ValueError(f"the PSFs were measured in {channels} colours, and {path} has {colors}")
    if capture.noise is None and not system.step:
        raise ValueError(f"the noise of {path} is not known: give --noise")


def _check_lens(measured: ThinLensCamera, own: ThinLensCamera) -> None:
    """Raise ``ValueError`` if the lens of the PSFs is not that of a system, or their pixels are not as large."""
    for name in ("pixel_pitch", "focal_length", "aperture_diameter", "focus_distance"):
        here, there = float(getattr(measured, name)), float(getattr(own, name))
        if abs(1 / here - 1 / there) > SAME_LENS * max(1 / here, 1 / there):  # a focus may be infinite
            raise ValueError(
                f"the PSFs were measured with a {name.replace('_', ' ')} of {here:.4g} m, and the network is for "
                f"{there:.4g} m"
            )


def _check_range(psfs: MeasuredPSFs, own: ThinLensCamera) -> None:
    """Raise ``ValueError`` if a system is for depths far beyond those that were measured."""
    lo, hi = own.defocus_range
    first, last = psfs.bank.defocus[[0, -1]].tolist()
    if lo < first - DEFOCUS_BEYOND or hi > last + DEFOCUS_BEYOND:
        near, far = own.depth_range
        (measured_near, measured_far) = psfs.distances.min(), psfs.distances.max()
        raise ValueError(
            f"the PSFs were measured from {measured_near:.4g} to {measured_far:.4g} m, and the network is for depths "
            f"from {near:.4g} to {far:.4g} m"
        )
