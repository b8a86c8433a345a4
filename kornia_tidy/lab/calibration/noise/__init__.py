"""Noise calibration by photon transfer: gain, read noise and full well of a sensor from its captures.

Pairs of flat fields, or a single picture with smooth areas, come in. The parameters of a ``SensorNoise`` go out. Read
``photon_transfer.py`` first.
"""

from kornia_tidy.lab.calibration.noise.photon_transfer import PhotonTransfer, photon_transfer

__all__ = [
    "PhotonTransfer",
    "photon_transfer",
]
