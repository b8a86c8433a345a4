"""webdataset: WebDataset README, decode and map."""

import io

import numpy as np
import webdataset as wds

from kornia_tidy import TiDyOptics  # new

data = wds.WebDataset("scenes.tar", shardshuffle=False).decode("torchrgb", only="png")
data = data.map(lambda sample: (sample["png"], np.load(io.BytesIO(sample["npy"]))))
data = data.map(TiDyOptics().as_transform())  # new
image, depth = next(iter(data))
