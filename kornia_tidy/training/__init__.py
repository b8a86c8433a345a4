"""Training optics and network together: data, checkpoints, and the Lightning module that joins them.

The settings of a run come in, checkpoints of a trained system go out. Read ``run.py`` first. Lightning is an extra
(``pip install 'kornia-tidy[train]'``), imported by ``module``, ``data_module``, ``callbacks``, ``checkpoint`` and
``run`` only.
"""
