"""C sources with their build: from a wheel, or compiled when they are first wanted.

Tensors come in and tensors go out: each source has a file of operators (``torch.library``) with fake implementations,
for ``render/backends`` and ``psf``. Read ``gather_ops.py`` first; ``operators.py`` defines operators, and ``build.py``
loads C, compiled by ``compiler.py`` or taken from a wheel.
"""
