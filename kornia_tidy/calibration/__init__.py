"""Measuring a real camera: its noise from flat fields (``noise/``), its PSFs from captures of points (``psf/``).

Captures come in; a sensor's parameters, a PSF bank, or the mask that makes such PSFs go out.
"""
