"""C sources of the package and their build: compiled for the processor they run on when they are first wanted.

A source and a data type come in, a loaded library goes out, or None with the reason where there is no compiler. Read
``build.py`` first; the sources are called from ``render/backends`` and ``psf``.
"""
