"""kornia_tidy: a programmable camera, with masks that change during the exposure, in front of any PyTorch pipeline."""

__version__ = "0.1.0"
