"""datasets: Hugging Face Datasets documentation, Process image data, set_transform."""

from datasets import Dataset, Image

from kornia_tidy import TiDyOptics  # new

names = [f"{index}.png" for index in range(3)]
data = Dataset.from_dict({kind: [f"scenes/{kind}/{name}" for name in names] for kind in ("rgb", "depth")})
data = data.cast_column("rgb", Image()).cast_column("depth", Image())
data.set_transform(TiDyOptics().as_transform(image_key="rgb", depth_scale=0.001))  # new
sample = data[0]
image, depth = sample["rgb"], sample["depth"]
