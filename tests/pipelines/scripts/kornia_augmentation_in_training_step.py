"""kornia: kornia tutorials, Data augmentation on the GPU (augmentation as a module in the training step)."""

import kornia.augmentation as K
import torch
from scenes_of_user import Network, load
from torch import nn

from kornia_tidy import TiDyOptics  # new

images, depth = load()
augment = nn.Sequential(K.RandomBrightness((0.9, 1.1)), K.Normalize(0.5, 0.25))
model = Network()
model.optics = TiDyOptics()  # new
optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
for _ in range(2):
    image = images
    image = model.optics(images, depth)  # new
    prediction = model(augment(image))
    loss = nn.functional.l1_loss(prediction, depth)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
trained = model
