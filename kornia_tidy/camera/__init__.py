"""The whole camera: an image and its depth come in, a coded capture goes out, and gradients reach the masks.

Read ``tidy_optics.py`` first. Beside it stand shots read out one by one (``burst.py``), scenes that move during the
exposure (``motion.py``), the distortion of a real lens (``lens_distortion.py``) and the transform of a data set
(``dataset_transform.py``). ``samples.py`` reads the input of a camera, ``strips.py`` takes large images some rows at a
time, and ``saved_camera.py`` makes a camera from its state, of ``saved_parts.py``. A capture is planned by
``../accuracy/planning/planner.py``.
"""

from kornia_tidy.camera.burst import burst
from kornia_tidy.camera.dataset_transform import DatasetTransform
from kornia_tidy.camera.lens_distortion import distorted
from kornia_tidy.camera.motion import moving_capture
from kornia_tidy.camera.saved_camera import camera_of_state
from kornia_tidy.camera.tidy_optics import TiDyOptics

__all__ = [
    "DatasetTransform",
    "TiDyOptics",
    "burst",
    "camera_of_state",
    "distorted",
    "moving_capture",
]
