"""Published optical systems: nine cameras with their masks as data, with the source of every value.

The name of a system comes in. Its lens, initial masks, wavelengths, compositing and noise go out, as arguments of
``TiDyOptics``. ``system.py`` has the data type; read the table in ``presets.py`` first.
"""

from kornia_tidy.systems.presets import SYSTEMS, published_system, systems_table
from kornia_tidy.systems.system import System

__all__ = ["SYSTEMS", "System", "published_system", "systems_table"]
