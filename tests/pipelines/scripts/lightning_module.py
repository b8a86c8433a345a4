"""lightning: Lightning documentation, Lightning in 15 minutes."""

import lightning as L
import torch
from scenes_of_user import Network, load
from torch.utils.data import DataLoader, TensorDataset

from kornia_tidy import TiDyOptics  # new


class DepthEstimation(L.LightningModule):
    def __init__(self):
        super().__init__()
        self.network = Network()
        self.optics = TiDyOptics()  # new

    def training_step(self, batch, batch_idx):
        image, depth = batch
        image = self.optics(image, depth)  # new
        return torch.nn.functional.l1_loss(self.network(image), depth)

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=1e-3)


trained = DepthEstimation()
quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
trainer = L.Trainer(max_epochs=1, accelerator="cpu", **quiet)
trainer.fit(trained, DataLoader(TensorDataset(*load()), batch_size=3))
