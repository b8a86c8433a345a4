"""Trained systems: a camera with its learnt masks and the network that reads it.

A checkpoint comes in, a :class:`~kornia_tidy.inference.trained.TrainedSystem` goes out. Read ``trained.py`` first; the
systems that come with the package lie in ``pretrained/``.
"""
