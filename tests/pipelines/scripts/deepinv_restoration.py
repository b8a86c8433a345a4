"""deepinv: deepinv example, Image deblurring with total-variation prior."""

import deepinv as dinv
import torch
from scenes_of_user import load

from kornia_tidy import TiDyOptics  # new
from kornia_tidy.augmentation.deepinv_physics import CameraPhysics  # new

images, depths = load()
clean, depth = images[:1], depths[:1]
noise = dinv.physics.GaussianNoise(0.01)
# was: physics = dinv.physics.Denoising(noise)
physics = CameraPhysics(TiDyOptics().requires_grad_(False), depth, noise_model=noise)
fidelity, prior = dinv.optim.data_fidelity.L2(), dinv.optim.prior.TVPrior(n_it_max=5)
measured = physics(clean)
image = physics.A_adjoint(measured)
for _ in range(2):
    with torch.no_grad():
        image = prior.prox(image - fidelity.grad(image, measured, physics), gamma=0.005)
