"""Runtime support: how torch runs, precision of devices, signals, and where imports look for code.

It contains no optics. ``mode.py`` tells how torch runs, ``signals.py`` has Ctrl-C and SIGTERM of the command.
"""
