"""Monocular depth networks of transformers as baselines: depth from one picture in focus everywhere."""

from __future__ import annotations

import os
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.checks import check_part
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.midas_small import IMAGE_DEVIATION, IMAGE_MEAN
from kornia_tidy.search_path import import_extra

NEAREST = 1e-3  # m; smaller metric estimates are taken for this depth

# Published sizes by width: the layers used, the channels of their maps, and the channels of the fusion.
_DEPTH_ANYTHING = {
    384: ((3, 6, 9, 12), (48, 96, 192, 384), 64),
    768: ((3, 6, 9, 12), (96, 192, 384, 768), 128),
    1024: ((5, 12, 18, 24), (256, 512, 1024, 1024), 256),
}
_ZOEDEPTH = {1024: ((6, 12, 18, 24), (256, 512, 1024, 1024), 256)}


class MonocularDepth(ReconstructionHead):
    r"""Normalised inverse depth from a picture by a monocular depth network of transformers.

    The picture is resized and normalised as the network was trained, and its inverse depth d is mapped to the camera's
    range by two numbers,

    .. math:: n = a d + b.

    A relative network (Depth Anything V2) leaves a and b unknown. They are an affine fit to known depths, either of
    other scenes (:meth:`fit`) or, as papers score such networks, of the scored picture itself (:func:`fit_affine`): the
    second one uses the true depths, and a report must state this. A metric network (ZoeDepth) gives metres, so that the
    camera alone determines both (:meth:`for_camera`).

    Args:
        network: takes ``pixel_values`` and returns ``predicted_depth`` (B, h, w): inverse depth up to scale and shift,
            or metres.
        metric: whether it returns metres.
        side: length of a picture's shorter side after resizing, in pixels; the ratio of the sides is kept.
        multiple: both sides are rounded to multiples of this number of pixels, the network's patches.
        mean: of red, green and blue, for normalising a picture.
        deviation: of red, green and blue.

    Shape:
        - image: (B, 3, H, W), RGB in [0, 1], encoded as sRGB.
        - output: (B, 1, H, W), normalised inverse depth as for
          :func:`~kornia_tidy.reconstruction.tasks.normalised_inverse_depth`; not clamped to [0, 1].

    Convention:
        - a is 1 and b is 0 until :meth:`fit` or :meth:`for_camera` is called. Both are in the state.
        - Each output depends on the whole picture: it cannot be reconstructed in tiles.

    Source: Ranftl et al., Towards Robust Monocular Depth Estimation (TPAMI 2022), section 5, for the affine fit.
    """

    stride = 1
    whole_image = True

    def __init__(
        self,
        network: nn.Module,
        *,
        metric: bool,
        side: int,
        multiple: int,
        mean: tuple[float, float, float] = IMAGE_MEAN,
        deviation: tuple[float, float, float] = IMAGE_DEVIATION,
    ) -> None:
        super().__init__(3, 1)
        self.network = network
        self.metric, self.side, self.multiple = metric, side, multiple
        self.mean, self.deviation = mean, deviation
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("shift", torch.zeros(()))
        self.scale: Tensor
        self.shift: Tensor

    def predict(self, image: Tensor) -> Tensor:
        """Return normalised inverse depth."""
        return self.scale * self.inverse_depth(image) + self.shift

    def inverse_depth(self, image: Tensor) -> Tensor:
        """Return the network's own inverse depth, (B, 1, H, W): 1/metres if it is metric, else of unknown scale."""
        height, width = image.shape[-2:]
        size = working_size(height, width, self.side, self.multiple)
        constants = zip(image.split(1, 1), self.mean, self.deviation, strict=True)
        normalised = torch.cat([(colour - mean) / deviation for colour, mean, deviation in constants], 1)
        resized = functional.interpolate(normalised, size, mode="bicubic", antialias=True)
        found = self.network(pixel_values=resized).predicted_depth[:, None]
        found = found.clamp(min=NEAREST).reciprocal() if self.metric else found
        return functional.interpolate(found, (height, width), mode="bilinear")

    @torch.no_grad()
    def fit(self, image: Tensor, truth: Tensor, valid: Tensor | None = None) -> Self:
        """Set scale and shift by least squares over the pixels of scenes with known depth.

        Args:
            image: (B, 3, H, W), pictures in focus everywhere.
            truth: (B, 1, H, W), normalised inverse depth.
            valid: (B, 1, H, W) bool, True where the truth is known. Default: everywhere.

        Returns:
            The head.
        """
        known = torch.ones_like(truth, dtype=torch.bool) if valid is None else valid
        rows = [tensor.reshape(1, 1, 1, -1) for tensor in (self(image), truth, known)]
        scale, shift = fit_affine(*rows)
        self.shift.copy_(self.shift * scale.view(()) + shift.view(()))  # of the output, which had a fit already
        self.scale.mul_(scale.view(()))
        return self

    @torch.no_grad()
    def for_camera(self, camera: ThinLensCamera) -> Self:
        """Set scale and shift of a metric network from a camera: defocus is affine in inverse depth.

        Raises:
            TypeError: if the camera is not a :class:`~kornia_tidy.ThinLensCamera`.
            ValueError: if the network is not metric.
        """
        check_part("camera", camera, ThinLensCamera, "a ThinLensCamera, which has a metric scale")
        if not self.metric:
            raise ValueError("a relative network has no metric scale: fit it to known depths with fit()")
        lo, hi = camera.defocus_range
        far, near = ((camera.defocus(torch.tensor([torch.inf, 1.0], dtype=torch.float64)) - lo) / (hi - lo)).tolist()
        self.shift.fill_(far)
        self.scale.fill_(near - far)
        return self

    def extra_repr(self) -> str:
        """Return scale and shift, for ``repr``."""
        return f"metric={self.metric}, side={self.side}, scale={float(self.scale):.4g}, shift={float(self.shift):.4g}"


def working_size(height: int, width: int, side: int, multiple: int) -> tuple[int, int]:
    """Return the size in pixels at which a picture enters a network: rows and columns.

    Example:
        >>> working_size(480, 640, 518, 14)
        (518, 686)
    """
    scale = side / min(height, width)
    rows, columns = (max(1, round(length * scale / multiple)) * multiple for length in (height, width))
    return rows, columns


def fit_affine(estimate: Tensor, truth: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return scale and shift of the affine map from an estimate to the truth, by least squares in each image.

    .. math:: \min_{a, b} \sum_{valid} (a e + b - t)^2

    An estimate fitted to its image's true depth uses this depth. State this beside every score.

    Args:
        estimate: (B, 1, H, W).
        truth: (B, 1, H, W), finite where it is valid.
        valid: (B, 1, H, W) bool. Default: everywhere.

    Returns:
        a and b, each (B, 1, 1, 1), so that ``a * estimate + b`` is the fitted estimate. An estimate that is constant
        has a = 0 and the mean truth as b; an image without valid pixels has a = 0 and b = 0.

    Source: Ranftl et al. (TPAMI 2022), section 5.

    Example:
        >>> estimate = torch.tensor([[[[0.0, 1.0, 2.0]]]])
        >>> scale, shift = fit_affine(estimate, 3 * estimate - 1)
        >>> round(scale.item(), 4), round(shift.item(), 4)
        (3.0, -1.0)
    """
    weight = (torch.ones_like(truth) if valid is None else valid).double()
    e, t = (torch.where(weight > 0, x.double(), 0) for x in (estimate, truth))
    count = weight.sum((-3, -2, -1), keepdim=True).clamp(min=1)
    mean_e, mean_t = ((x * weight).sum((-3, -2, -1), keepdim=True) / count for x in (e, t))
    spread = ((e - mean_e).square() * weight).sum((-3, -2, -1), keepdim=True)
    shared = ((e - mean_e) * (t - mean_t) * weight).sum((-3, -2, -1), keepdim=True)
    scale = torch.where(spread > 0, shared / spread.clamp(min=torch.finfo(torch.float64).tiny), 0)
    return scale.to(estimate.dtype), (mean_t - scale * mean_e).to(estimate.dtype)


def depth_anything_v2(in_channels: int = 3, out_channels: int = 1, width: int = 384) -> MonocularDepth:
    """Return Depth Anything V2 with random weights; :func:`load_depth_anything_v2` loads published ones.

    Args:
        in_channels: 3.
        out_channels: 1: it estimates only depth.
        width: channels of its transformer, a multiple of 8: 384 is Small, 768 Base and 1024 Large; others are small
            networks of four layers.

    Raises:
        ImportError: if transformers is missing.
        ValueError: if a number is not as above.

    Source: Yang et al., Depth Anything V2 (NeurIPS 2024), with the sizes of its published models.
    """
    transformers = _transformers("depth-anything-v2", in_channels, out_channels, width)
    stages, neck, fusion = _DEPTH_ANYTHING.get(width, ((1, 2, 3, 4), (width // 2,) * 4, width // 2))
    encoder = transformers.Dinov2Config(
        hidden_size=width,
        num_hidden_layers=stages[-1],
        num_attention_heads=max(1, width // 64),
        image_size=518,
        patch_size=14,
        out_indices=list(stages),
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=encoder,
        reassemble_hidden_size=width,
        neck_hidden_sizes=list(neck),
        fusion_hidden_size=fusion,
    )
    return _depth_anything(transformers.DepthAnythingForDepthEstimation(config))


def zoedepth(in_channels: int = 3, out_channels: int = 1, width: int = 1024) -> MonocularDepth:
    """Return ZoeDepth with random weights; :func:`load_zoedepth` loads published ones.

    Args:
        in_channels: 3.
        out_channels: 1: it estimates only depth.
        width: channels of its transformer, a multiple of 8: 1024 is the published size; others are small networks of
            four layers.

    Raises:
        ImportError: if transformers is missing.
        ValueError: if a number is not as above.

    Source: Bhat et al., ZoeDepth (2023), the model for NYU Depth v2.
    """
    transformers = _transformers("zoedepth", in_channels, out_channels, width)
    stages, neck, fusion = _ZOEDEPTH.get(width, ((1, 2, 3, 4), (width // 2,) * 4, width // 2))
    encoder = transformers.BeitConfig(
        hidden_size=width,
        num_hidden_layers=stages[-1],
        num_attention_heads=max(1, width // 64),
        intermediate_size=4 * width,
        image_size=384,
        use_relative_position_bias=True,
        reshape_hidden_states=False,
        out_features=[f"stage{stage}" for stage in stages],
    )
    config = transformers.ZoeDepthConfig(
        backbone_config=encoder,
        neck_hidden_sizes=list(neck),
        fusion_hidden_size=fusion,
        bottleneck_features=fusion,
    )
    return _zoedepth(transformers.ZoeDepthForDepthEstimation(config))


def load_depth_anything_v2(name_or_folder: str | os.PathLike[str], **options: Any) -> MonocularDepth:
    """Load Depth Anything V2 through transformers, from a folder or the Hugging Face Hub; nothing is unpickled.

    Args:
        name_or_folder: such as ``"depth-anything/Depth-Anything-V2-Small-hf"``, or a folder with ``config.json`` and
            ``model.safetensors``. A model for metric depth is recognised.
        **options: passed on to ``from_pretrained``, such as ``revision=`` and ``local_files_only=True``.

    Returns:
        The head in eval mode, without a fit: see :meth:`MonocularDepth.fit`.

    Raises:
        ImportError: if transformers is missing.
        ValueError: if weights are missing from the files.
        OSError: if the folder or repository is missing.
    """
    return _depth_anything(_load("DepthAnythingForDepthEstimation", name_or_folder, options)).eval()


def load_zoedepth(name_or_folder: str | os.PathLike[str], **options: Any) -> MonocularDepth:
    """Load ZoeDepth through transformers, from a folder or the Hugging Face Hub; nothing is unpickled.

    Args:
        name_or_folder: such as ``"Intel/zoedepth-nyu"``, or a folder with ``config.json`` and ``model.safetensors``.
        **options: passed on to ``from_pretrained``, such as ``revision=`` and ``local_files_only=True``.

    Returns:
        The head in eval mode, of no camera: see :meth:`MonocularDepth.for_camera`.

    Raises:
        ImportError: if transformers is missing.
        ValueError: if weights are missing from the files.
        OSError: if the folder or repository is missing.
    """
    return _zoedepth(_load("ZoeDepthForDepthEstimation", name_or_folder, options)).eval()


def _depth_anything(network: Any) -> MonocularDepth:
    metric = network.config.depth_estimation_type == "metric"
    return MonocularDepth(network, metric=metric, side=518, multiple=network.config.patch_size)


def _zoedepth(network: Any) -> MonocularDepth:
    half = (0.5, 0.5, 0.5)
    return MonocularDepth(network, metric=True, side=384, multiple=32, mean=half, deviation=half)


def _load(kind: str, name_or_folder: str | os.PathLike[str], options: dict[str, Any]) -> Any:
    """Return a network of transformers with all of its weights, from safetensors."""
    options = {"use_safetensors": True, **options, "output_loading_info": True}
    published = getattr(import_extra("transformers", kind), kind)
    network, info = published.from_pretrained(os.fspath(name_or_folder), **options)
    if missing := sorted(info["missing_keys"]):  # transformers draws them at random and goes on
        raise ValueError(f"cannot read {name_or_folder}: {len(missing)} weights are missing, first {missing[0]}")
    return network


def _transformers(name: str, in_channels: int, out_channels: int, width: int) -> Any:
    """Return the module transformers, once the arguments are checked."""
    if (in_channels, out_channels) != (3, 1):
        raise ValueError(
            f"{name} takes 3 channels and estimates only depth, 1 map, got {in_channels} and {out_channels}"
        )
    if not isinstance(width, int) or width < 8 or width % 8 or (width > 64 and width % 64):
        raise ValueError(f"width must be a multiple of 8, above 64 of 64, got {width!r}")
    return import_extra("transformers", name)
