"""Joint training of optics and network: settings of a run, data, checkpoints and the Lightning module.

The settings of a run come in, checkpoints of a trained system go out. Read ``run.py`` first, and ``noisy_crops.py`` for
training only the network. Lightning is an extra
(``pip install 'kornia-tidy[train]'``), imported by ``module``, ``data_module``, ``callbacks``, ``checkpoint`` and
``run`` only.
"""
