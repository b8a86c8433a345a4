"""From coded images back to the scene: networks that estimate the all-in-focus image, the depth, or both."""

from kornia_tidy.reconstruction.attention_unet import AttentionUNet
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.joint import JointEstimate, JointHead
from kornia_tidy.reconstruction.midas_small import MiDaSSmall, load_midas_small
from kornia_tidy.reconstruction.phasecam3d_unet import PhaseCam3DUNet

__all__ = [
    "AttentionUNet",
    "JointEstimate",
    "JointHead",
    "MiDaSSmall",
    "PhaseCam3DUNet",
    "ReconstructionHead",
    "load_midas_small",
]
