"""What goes on around a computation: threads that share one camera, and what torch makes of it as it runs.

Nothing of light is known here. Read ``tracing.py`` for compilers and function transforms, ``threads.py`` for locks.
"""
