"""torch: PyTorch tutorials, Training with PyTorch (the plain loop)."""

import torch
from scenes_of_user import Network, Scenes
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics  # new

model = Network()
model.optics = TiDyOptics()  # new
optimizer = torch.optim.SGD(model.parameters(), lr=0.01, momentum=0.9)
for sample in DataLoader(Scenes(), batch_size=2, shuffle=True):
    batch = sample
    batch = model.optics(sample)  # new
    loss = (model(batch["image"]) - batch["depth"]).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
image, depth, trained = batch["image"], batch["depth"], model
