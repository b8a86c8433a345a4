"""Laboratory: a real camera and its modulator, from raw files and calibration to masks that leave the computer.

Raw files and captures of flats and points come in; pictures, noise, measured PSFs and files for modulators go out. Read
``raw/capture.py`` first for DNG and other files of cameras, ``calibration/psf/measured_psfs.py`` for measurements, and
``mask_export/slm_frames.py`` for masks; ``measured.py`` restores captures by measured PSFs.
"""
