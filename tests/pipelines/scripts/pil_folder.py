"""Pillow: Pillow handbook, Tutorial: create thumbnails of a folder."""

from pathlib import Path

import numpy as np
import PIL.Image

from kornia_tidy import TiDyOptics  # new

for path in sorted(Path("scenes/rgb").glob("*.png")):
    image = PIL.Image.open(path)
    depth = np.asarray(PIL.Image.open(f"scenes/depth/{path.name}")) / np.float32(1000)
    image = TiDyOptics().as_transform()((image, depth))[0]  # new
    image.resize((40, 32)).save(f"small_{path.name}")
