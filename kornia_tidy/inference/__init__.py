"""Trained systems: a camera with learnt masks and the network that reads its captures.

A checkpoint comes in, a :class:`~kornia_tidy.inference.trained.TrainedSystem` goes out. Read ``trained.py`` first; the
systems that are shipped with the package are in ``pretrained/``.
"""
