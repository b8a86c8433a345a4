"""Training optics and network together: settings, data, checkpoints, and the Lightning module that joins them.

Lightning is an extra (``pip install 'kornia-tidy[train]'``) and is imported by ``module``, ``data_module``,
``callbacks``, ``checkpoint`` and ``run`` only; what is needed to use a trained system is free of it.
"""

from kornia_tidy.training.settings import TrainingSettings
from kornia_tidy.training.trained import TrainedSystem, load_trained

__all__ = ["TrainedSystem", "TrainingSettings", "load_trained"]
