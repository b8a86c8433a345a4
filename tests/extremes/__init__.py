"""Extremes: how exact the camera stays far from usual settings, and what happens beyond them.

``make extremes`` measures every row of ``docs/record/extremes.md``; ``test_extremes.py`` checks the quick ones.
"""
