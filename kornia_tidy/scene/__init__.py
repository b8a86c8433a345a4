"""Geometry: from a defocus map and a PSF bank to the irradiance on the sensor."""
