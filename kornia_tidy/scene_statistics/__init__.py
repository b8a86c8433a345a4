"""Scene statistics: power spectrum and light of photographs, and how their depths are distributed.

Published numbers come out, or the user's pictures and depth maps come in and the same numbers for them go out. Mask
design, planning and the Wiener filter take them. Read ``statistics.py`` first.
"""

from kornia_tidy.scene_statistics.measurement import measured_statistics
from kornia_tidy.scene_statistics.statistics import PHOTOGRAPHS, SceneStatistics

__all__ = ["PHOTOGRAPHS", "SceneStatistics", "measured_statistics"]
