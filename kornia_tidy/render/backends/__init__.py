"""Ways to compute one rendering: dense (the definition), tiled by transforms, and direct convolution in C.

Light, layers and PSFs come in, light goes out, the same to rounding whichever way is taken. Read ``tiled.py`` first.
"""
