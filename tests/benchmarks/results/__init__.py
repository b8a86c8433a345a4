"""Benchmark of results: scores of images and depth, by optical system, restoration and noise, on the same scenes.

- Scenes: the 35 real scenes of ``../shared/data`` (middle 512 pixels, depths stretched in dioptres over the camera's
  range) and dead leaves. Each set is split by a fixed seed: settings are chosen on half A, half B only scores.
- Captures: PSFs of 129 pixels, the light outside them as an even background, in linear light. Noise is either Gaussian
  of one standard deviation, or shot and read noise at equal exposure time for all f-numbers.
- Differences are paired: taken scene by scene, then averaged, with the standard error of that mean.

``measure.py`` runs it and keeps every value in ``store.py``; ``report.py`` writes the tables, ``verdicts.py`` compares
with the targets. A new restoration is a line in ``restorations.py``, a new optical system one in ``optics.py``.
"""
