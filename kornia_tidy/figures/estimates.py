"""Figure of reconstructions: captures of several cameras, the networks' images and depth maps, and error maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from kornia_tidy.figures.depth import depth_colors
from kornia_tidy.figures.style import ACCENT, FAINT, LABEL, TITLE, require_matplotlib
from kornia_tidy.reconstruction.metrics import psnr, rmse, ssim

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ERROR_SCALE = 3.0  # factor on error maps, so that small errors are visible
COLUMN, MARGIN = 2.3, 0.3  # inches
HEADINGS = ("the scene", "capture", "all-in-focus estimate", "its error, x3", "depth estimate", "its error, x3")
PREDICTED = "the error it predicts, x3"


class Estimate(NamedTuple):
    """Capture of one camera with its network's estimates, (C, H, W); depth is normalised inverse depth or None."""

    name: str
    capture: Tensor
    image: Tensor
    inverse_depth: Tensor | None
    deviation: Tensor | None = None
    """Standard deviation of ``inverse_depth``, if the network tells it."""

    def scores(self, image: Tensor, inverse_depth: Tensor, known: Tensor | None = None) -> dict[str, float]:
        """Return PSNR (dB) of capture and image, SSIM of the image, and RMSE of the known normalised inverse depth."""
        truth = image[None]
        scores = {
            "capture_psnr": float(psnr(self.capture[None], truth)),
            "image_psnr": float(psnr(self.image[None].clamp(0, 1), truth)),
            "image_ssim": float(ssim(self.image[None].clamp(0, 1), truth)),
        }
        if self.inverse_depth is None:
            return scores
        where = None if known is None else known[None]
        return {**scores, "depth_rmse": float(rmse(self.inverse_depth[None].clamp(0, 1), inverse_depth[None], where))}


def draw_estimates(
    image: Tensor, inverse_depth: Tensor, estimates: Sequence[Estimate], known: Tensor | None = None
) -> Figure:
    """Draw one row for each camera: the capture, the estimated image and depth, and error maps.

    The depth columns of a network without depth estimate stay empty. If a network tells the standard deviation of its
    depth, a last column shows it beside the error, at the same scale.

    Args:
        image: the scene in focus, (3, H, W) in [0, 1].
        inverse_depth: normalised inverse depth of the scene, (1, H, W): 0 at the far and 1 at the near end of
            the range.
        estimates: of two cameras or more, from top to bottom. The scene is drawn beside the first row, its depth beside
            the second.
        known: bool (1, H, W), True where the depth is known. None: everywhere.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it some 2200 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if there are fewer than two estimates.
    """
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    if len(estimates) < 2:
        raise ValueError(f"the picture compares two estimates or more, got {len(estimates)}")
    headings = HEADINGS if all(estimate.deviation is None for estimate in estimates) else (*HEADINGS, PREDICTED)
    row = COLUMN * image.shape[-2] / image.shape[-1] + 0.35
    height = 0.7 + row * len(estimates)
    figure = Figure(figsize=(len(headings) * COLUMN + 2 * MARGIN, height), facecolor="white")
    axes = figure.subplots(len(estimates), len(headings), squeeze=False)
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.12 / height, top=1 - 0.75 / height, wspace=0.03, hspace=0.12)
    figure.text(0.02, 1 - 0.28 / height, "From one coded capture: everything in focus, and how far it is", fontsize=14)
    legend = (
        "K: masks shown in turn during the exposure; plain: a Fresnel lens; EDoF: learnt for the image alone; "
        "x3: times three"
    )
    figure.text(0.98, 1 - 0.28 / height, legend, fontsize=LABEL, color=FAINT, ha="right")
    for y, estimate in enumerate(estimates):
        scores = estimate.scores(image, inverse_depth, known)
        pictures = [
            (estimate.capture, f"{scores['capture_psnr']:.1f} dB"),
            (estimate.image, f"{scores['image_psnr']:.1f} dB, SSIM {scores['image_ssim']:.2f}"),
            ((estimate.image - image).abs() * ERROR_SCALE, ""),
        ]
        if estimate.inverse_depth is not None:
            pictures += [
                (depth_colors(estimate.inverse_depth), f"RMSE {scores['depth_rmse']:.3f} of the range"),
                ((estimate.inverse_depth - inverse_depth).abs().expand(3, -1, -1) * ERROR_SCALE, ""),
            ]
        if estimate.deviation is not None:
            pictures.append((estimate.deviation.expand(3, -1, -1) * ERROR_SCALE, ""))
        for empty in axes[y][1 + len(pictures) :]:
            empty.set_axis_off()
        for x, (picture, words) in enumerate(pictures, start=1):
            _show(axes[y][x], picture, words, headings[x] if y == 0 else "")
        axes[y][1].text(
            0.03,
            0.95,
            estimate.name,
            fontsize=TITLE,
            color="white",
            weight="bold",
            va="top",
            transform=axes[y][1].transAxes,
            bbox={"facecolor": ACCENT, "linewidth": 0, "pad": 2},
        )
        scene = (image, "") if y == 0 else (depth_colors(inverse_depth), "its depth; bright is near")
        if y < 2:
            _show(axes[y][0], *scene, headings[0] if y == 0 else "")
        else:
            axes[y][0].set_axis_off()
    return figure


def _show(axes: Axes, picture: Tensor, words: str, heading: str) -> None:
    axes.imshow(picture.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy(), interpolation="antialiased")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_xlabel(words, fontsize=LABEL, color=FAINT, labelpad=2)
    if heading:
        axes.set_title(heading, fontsize=TITLE, color=ACCENT, weight="bold", loc="left")
