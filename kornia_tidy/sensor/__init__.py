"""Electrons: from irradiance to digital numbers."""
