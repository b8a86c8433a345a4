"""Put a learnable camera in front of an ordinary PyTorch training loop, here for depth.

python examples/plain_training_loop.py --steps 200
"""

import argparse

import torch

from kornia_tidy import TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction.heads import PlainHead
from kornia_tidy.reconstruction.losses import mse_loss
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth


def main(arguments: list[str] | None = None) -> list[float]:
    """Train, and return the loss of every step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100, help="steps (default: 100)")
    scenes = DeadLeaves(4 * parser.parse_args(arguments).steps, 64, 64)
    torch.manual_seed(0)
    network, optics = PlainHead(out_channels=1), TiDyOptics()  # line 1: the camera
    groups = [*optics.parameter_groups(lr_metres=1e-8), {"params": network.parameters()}]  # line 2: its masks
    optimizer = torch.optim.Adam(groups, lr=1e-3, betas=(0.99, 0.999))
    losses = []
    for batch in torch.utils.data.DataLoader(scenes, batch_size=4):
        coded = optics(batch["image"], batch["depth"])  # line 3: the network sees captures, not images
        loss = mse_loss(network(coded), normalised_inverse_depth(optics.camera, batch["depth"]), batch["mask"])
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    print(f"loss {losses[0]:.4f} at first, {losses[-1]:.4f} at last")
    return losses


if __name__ == "__main__":
    main()
