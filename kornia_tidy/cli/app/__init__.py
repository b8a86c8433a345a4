"""Interactive page in the browser: scene, masks, PSFs, coded capture and its reconstruction for any settings.

Settings come in, from the controls of a page in the browser or as ``Settings``; pictures, their legends and a Python
script of the same capture go out. All but ``page.py`` works without Gradio. Read ``settings.py`` first, then
``capture.py``.
"""
