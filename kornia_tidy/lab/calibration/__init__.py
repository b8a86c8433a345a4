"""Calibration of a real camera: its noise from flat fields (``noise/``), its PSFs from captures of points (``psf/``).

Raw captures come in. Sensor parameters, a measured PSF bank, or the mask that explains the measured PSFs go out. Read
``noise/photon_transfer.py`` or ``psf/measured_psfs.py`` first.
"""
