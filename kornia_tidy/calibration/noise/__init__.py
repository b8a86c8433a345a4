"""Photon transfer: pairs of flat fields come in; gain, read noise and full well of a sensor go out.

Read ``photon_transfer.py`` first.
"""

from kornia_tidy.calibration.noise.photon_transfer import PhotonTransfer, photon_transfer

__all__ = [
    "PhotonTransfer",
    "photon_transfer",
]
