"""Reconstruction of the all-in-focus image and of depth from captures: networks, inversion, trained systems, metrics.

Captures come in, maps of the same size go out. Read ``head.py``, the base class of the networks, first; ``trained.py``
joins a camera with learnt masks and the network that reads its captures, and ``pretrained/`` has the systems that are
shipped. The names below are imported when they are first asked for: settings are read without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kornia_tidy.lazy import importer

if TYPE_CHECKING:
    from kornia_tidy.reconstruction.any_camera import AnyCameraHead
    from kornia_tidy.reconstruction.attention_unet import AttentionUNet
    from kornia_tidy.reconstruction.closed_form import ClosedForm, Restoration, closed_form_channels
    from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead
    from kornia_tidy.reconstruction.head import ReconstructionHead
    from kornia_tidy.reconstruction.joint import JointEstimate, JointHead, UncertainJointEstimate
    from kornia_tidy.reconstruction.joint_closed_form import JointClosedFormHead
    from kornia_tidy.reconstruction.layered_joint import LayeredJointHead
    from kornia_tidy.reconstruction.midas_small import MiDaSSmall, load_midas_small
    from kornia_tidy.reconstruction.nafnet import NAFNet
    from kornia_tidy.reconstruction.phasecam3d_unet import PhaseCam3DUNet
    from kornia_tidy.reconstruction.receptive_field import receptive_field
    from kornia_tidy.reconstruction.refocused import Refocused
    from kornia_tidy.reconstruction.residual import Residual
    from kornia_tidy.reconstruction.restored_over_field import restored_over_field
    from kornia_tidy.reconstruction.ruled_closed_form import RuledClosedForm
    from kornia_tidy.reconstruction.self_ensemble import SelfEnsemble, self_ensemble
    from kornia_tidy.reconstruction.tikhonov import Tikhonov, TikhonovLayers
    from kornia_tidy.reconstruction.tiled import reconstruct_tiled
    from kornia_tidy.reconstruction.wiener import Wiener

__all__ = [
    "AnyCameraHead",
    "AttentionUNet",
    "ClosedForm",
    "ClosedFormHead",
    "JointClosedFormHead",
    "JointEstimate",
    "JointHead",
    "LayeredJointHead",
    "MiDaSSmall",
    "NAFNet",
    "PhaseCam3DUNet",
    "ReconstructionHead",
    "Refocused",
    "Residual",
    "Restoration",
    "RuledClosedForm",
    "SelfEnsemble",
    "Tikhonov",
    "TikhonovLayers",
    "UncertainJointEstimate",
    "Wiener",
    "closed_form_channels",
    "load_midas_small",
    "receptive_field",
    "reconstruct_tiled",
    "restored_over_field",
    "self_ensemble",
]

__getattr__ = importer(__name__)
