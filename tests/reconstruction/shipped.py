"""The shipped systems, loaded once for all tests that do not change them."""

from __future__ import annotations

from functools import cache

from kornia_tidy.reconstruction.pretrained import load_pretrained

shipped = cache(load_pretrained)
