"""Runtime support: locks for cameras shared by threads, signals, and how torch runs.

It contains no optics. ``mode.py`` tells how torch runs, ``threads.py`` has the locks, ``signals.py`` Ctrl-C and SIGTERM
of the command.
"""
