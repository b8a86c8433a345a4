"""lightning: Lightning documentation, LightningDataModule."""

import lightning as L
from scenes_of_user import Scenes
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics  # new


class SceneData(L.LightningDataModule):
    def setup(self, stage=None):
        # was: self.train = Scenes()
        self.train = Scenes(transform=TiDyOptics().as_transform(seed=1))

    def train_dataloader(self):
        return DataLoader(self.train, batch_size=3)


data = SceneData()
data.setup("fit")
batch = next(iter(data.train_dataloader()))
image, depth = batch["image"], batch["depth"]
