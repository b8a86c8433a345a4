"""Published optical systems: nine cameras with their masks, every value with the place it was read."""

from kornia_tidy.systems.presets import SYSTEMS, published_system
from kornia_tidy.systems.system import System

__all__ = ["SYSTEMS", "System", "published_system"]
