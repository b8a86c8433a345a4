"""monai: MONAI tutorials, 3D segmentation (transforms of dictionaries)."""

from monai.transforms import Compose, RandFlipd, ScaleIntensityd
from scenes_of_user import load

from kornia_tidy import TiDyOptics  # new

images, depths = load()
steps = [RandFlipd(keys=["img", "depth"], prob=1.0, spatial_axis=1)]
steps += [TiDyOptics().as_transform(image_key="img")]  # new
steps += [ScaleIntensityd(keys=["img"])]
sample = Compose(steps)({"img": images[0], "depth": depths[0]})
image, depth = sample["img"], sample["depth"]
