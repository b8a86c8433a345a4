"""Runtime support: locks for cameras shared by threads, and detection of torch's compiler and function transforms.

It contains no optics. ``tracing.py`` has the compiler and function transforms, ``threads.py`` the locks.
"""
