"""C sources with their build, and kernels in Triton for GPUs: compiled where they run, when they are first wanted.

Tensors come in and tensors go out: each source has a file of operators (``torch.library``) with fake implementations
and gradients, for ``render/backends`` and ``psf``. Read ``gather_ops.py`` first; ``build.py`` compiles and loads
C, ``triton_ops.py`` launches on GPUs.
"""
