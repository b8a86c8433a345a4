"""Runtime support: locks for cameras shared by threads, signals, and detection of torch's compiler and transforms.

It contains no optics. ``tracing.py`` has the compiler and function transforms, ``threads.py`` the locks, ``signals.py``
Ctrl-C and SIGTERM of the command.
"""
