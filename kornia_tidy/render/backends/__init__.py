"""Backends of the renderer: dense (the definition), tiled by transforms, and direct convolution in C.

A layered scene comes in, light goes out, the same to rounding whichever backend renders it. Read ``dense.py`` first.
"""
