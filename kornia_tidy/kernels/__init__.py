"""C sources of the package and their build: compiled for the processor they run on when they are first wanted.

Tensors come in and tensors go out: each source has a file of operators (``torch.library``) with fake implementations
and gradients, for ``render/backends`` and ``psf``. Read ``gather_ops.py`` first; ``build.py`` compiles and loads.
"""
