"""Published optical systems: nine cameras with their masks, every value with the place it was read."""

from kornia_tidy.systems.presets import SYSTEMS, System, published_system

__all__ = ["SYSTEMS", "System", "published_system"]
