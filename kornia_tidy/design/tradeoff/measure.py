"""Measurement of time, memory and error of captures at different fidelities, on the user's own scene."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.choices import KNOBS
from kornia_tidy.design.tradeoff.costs import peak_bytes, seconds
from kornia_tidy.design.tradeoff.sweep_settings import PLAN, PRESET, Setting, Value, planned, sweep_settings
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.render.borders import largest_window


@dataclass(frozen=True)
class TradeRow:
    """Time, memory and error of one fidelity on one scene.

    Args:
        knob: name of the varied setting, ``"preset"`` or ``"plan"``.
        value: its value; the name of a preset, the tolerance of a plan.
        fidelity: all settings.
        layers: PSFs over defocus in the bank.
        window: side of the PSFs in pixels.
        rmse: root of the mean squared difference from the reference capture, full scale 1.
        max_error: largest difference of one sample.
        capture_seconds: time of a capture with changed masks: PSF bank and rendering, no gradients. Tables that depend
            on neither masks nor scene are cached. All times are medians over the repeats.
        capture_spread: its interquartile range in seconds.
        render_seconds: time of a capture with the cached PSF bank of the one before.
        render_spread: its interquartile range in seconds.
        training_seconds: time of a capture with the gradients of its mean in the masks; None if not measured.
        training_spread: its interquartile range in seconds.
        capture_bytes: peak memory of tensors in a capture, see
            :func:`~kornia_tidy.design.tradeoff.costs.peak_bytes`.
        training_bytes: the same for the capture with gradients.
        repeats: number of runs asked for; slow captures are repeated less often, see
            :func:`~kornia_tidy.design.tradeoff.costs.seconds`.
    """

    knob: str
    value: Value
    fidelity: Fidelity
    layers: int
    window: int
    rmse: float
    max_error: float
    capture_seconds: float
    capture_spread: float
    render_seconds: float
    render_spread: float
    training_seconds: float | None
    training_spread: float | None
    capture_bytes: int
    training_bytes: int | None
    repeats: int


def scene_settings(
    optics: TiDyOptics, image: Tensor, depth: Tensor, base: str | Fidelity = "balanced", knobs: Iterable[str] = KNOBS
) -> list[Setting]:
    """Return the points of a sweep for a scene, without windows wider than its border allows, and the plans for it.

    Args:
        optics: the camera.
        image: (C, H, W), in the colour space of the camera.
        depth: (1, H, W), metres.
        base: preset or fidelity; its settings are varied one at a time.
        knobs: names of settings; ``"preset"`` for the presets, ``"plan"`` for the plans.

    Raises:
        ValueError: if a name is not known.

    Example:
        >>> from kornia_tidy import PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(1, initial="flat"))
        >>> image, depth = torch.rand(3, 32, 32), torch.full((1, 32, 32), 0.9)
        >>> [step.value for step in scene_settings(optics, image, depth, knobs=["window"])]
        [9, 17, 33, None]
    """
    widest, knobs = largest_window(optics.border, *image.shape[-2:]), tuple(knobs)
    steps = sweep_settings(base, [knob for knob in knobs if knob != PLAN])
    real = optics.lens is not None
    settings = [
        s for s in steps if (s.fidelity.window or 1) <= widest and not (real and s.fidelity.propagation == "paper")
    ]
    return settings + (planned(optics, linear_light(optics, image)[None], depth[None]) if PLAN in knobs else [])


def sweep(
    optics: TiDyOptics,
    image: Tensor,
    depth: Tensor,
    settings: Iterable[Setting],
    *,
    repeats: int = 5,
    training: bool = False,
    reference: str | Fidelity = "reference",
) -> Iterator[TradeRow]:
    """Measure settings one after another, and yield each row when it is measured.

    Args:
        optics: the camera: its masks, lens, modulator, spectrum, compositing and border, on the device to measure.
            Its sensor and fidelity do not matter.
        image: (C, H, W) or (B, C, H, W) in the camera's colour space, on the same device.
        depth: its depth, (1, H, W) or (B, 1, H, W).
        settings: points of the sweep, see :func:`~kornia_tidy.design.tradeoff.sweep_settings.sweep_settings`.
        repeats: timed runs of each.
        training: also measure captures with gradients.
        reference: the fidelity to which errors refer.

    Returns:
        Rows in the order of the settings. Equal settings with two names are measured once.

    Raises:
        ValueError: if the border is ``"valid"`` (captures would differ in size), or repeats are not positive.

    Example:
        >>> from kornia_tidy.design.tradeoff.sweep_settings import sweep_settings
        >>> optics = TiDyOptics(fidelity="draft")
        >>> image, depth = torch.rand(3, 48, 48), torch.full((1, 48, 48), 0.8)
        >>> rows = sweep(optics, image, depth, sweep_settings("draft", ["window"])[:2], repeats=1, reference="balanced")
        >>> [(row.window, row.rmse > 0) for row in rows]
        [(9, True), (17, True)]
    """
    measured: dict[Fidelity, TradeRow] = {}
    truth = None
    for setting in settings:
        key = _knobs(setting.fidelity)
        if key not in measured:
            truth = capture(optics, image, depth, reference) if truth is None else truth
            measured[key] = measure(optics, image, depth, setting.fidelity, truth, repeats=repeats, training=training)
        yield replace(measured[key], **setting._asdict())


def _knobs(fidelity: Fidelity) -> Fidelity:
    """Return a fidelity without its name, for comparison."""
    return replace(fidelity, name="")


def measure(
    optics: TiDyOptics,
    image: Tensor,
    depth: Tensor,
    fidelity: str | Fidelity,
    truth: Tensor,
    *,
    repeats: int = 5,
    training: bool = False,
) -> TradeRow:
    """Measure one setting: time, memory, and error against the reference capture.

    Args:
        optics: the camera, see :func:`sweep`.
        image: (C, H, W) or (B, C, H, W).
        depth: its depth.
        fidelity: the setting.
        truth: the reference capture from :func:`capture`.
        repeats: timed runs.
        training: also measure the capture with gradients.

    Raises:
        ValueError: if ``truth`` has another shape than the image, repeats are not positive, or the masks have no
            parameters to train.
    """
    if truth.shape != image.shape:
        raise ValueError(f"truth must have the image's shape {tuple(image.shape)}, got {tuple(truth.shape)}")
    light, device = linear_light(optics, image), image.device
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # windows, aliasing, clamping: the error includes them
        camera = _camera(optics, fidelity, image)
        moving = [p for p in camera.masks.parameters() if p.requires_grad]
        if training and not moving:
            raise ValueError(f"training needs masks that can be learned, got {camera.masks.extra_repr()}")

        def capture_once() -> Tensor:
            _touch(camera)
            return camera(light, depth)

        def train_once() -> Any:
            return torch.autograd.grad(capture_once().mean(), moving)

        with torch.no_grad():
            difference = (camera(light, depth) - truth).double()
            whole = seconds(capture_once, repeats, device)
            camera = _camera(optics, fidelity, image)  # a new camera has no cache of an earlier capture to free
            memory = peak_bytes(capture_once, device)
            rendering = seconds(lambda: camera(light, depth), repeats, device)
        gradients, gradients_memory = None, None
        if training:
            camera = _camera(optics, fidelity, image)
            gradients_memory = peak_bytes(train_once, device)
            gradients = seconds(train_once, repeats, device)
    return TradeRow(
        knob=PRESET,
        value=camera.fidelity.name,
        fidelity=camera.fidelity,
        layers=len(camera.defocus_nodes),
        window=camera.window,
        rmse=float(difference.square().mean().sqrt()),
        max_error=float(difference.abs().max()),
        capture_seconds=whole.median,
        capture_spread=whole.spread,
        render_seconds=rendering.median,
        render_spread=rendering.spread,
        training_seconds=gradients.median if gradients else None,
        training_spread=gradients.spread if gradients else None,
        capture_bytes=memory,
        training_bytes=gradients_memory,
        repeats=repeats,
    )


@torch.no_grad()
def capture(optics: TiDyOptics, image: Tensor, depth: Tensor, fidelity: str | Fidelity = "reference") -> Tensor:
    """Return the noise-free capture of a camera at a fidelity, in linear light with the image's shape and dtype.

    Example:
        >>> capture(TiDyOptics(), torch.ones(3, 64, 64), torch.ones(1, 64, 64), "draft").mean().round(decimals=4)
        tensor(1.)
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _camera(optics, fidelity, image)(linear_light(optics, image), depth)


def pareto(rows: Iterable[TradeRow]) -> list[TradeRow]:
    """Return the Pareto front of capture time and error, fastest row first.

    Example:
        >>> pareto([])
        []
    """
    front: list[TradeRow] = []
    for row in sorted(rows, key=lambda row: (row.capture_seconds, row.rmse)):
        if not front or row.rmse < front[-1].rmse:
            front.append(row)
    return front


def linear_light(optics: TiDyOptics, image: Tensor) -> Tensor:
    """Decode an image, batched or not, to linear light."""
    return optics.decode(image if image.ndim == 4 else image[None]).reshape(image.shape)


def _camera(optics: TiDyOptics, fidelity: str | Fidelity, image: Tensor) -> TiDyOptics:
    """Return a noise-free copy of a camera in linear light at another fidelity, its window limited by the border."""
    if optics.border == "valid":
        raise ValueError("captures at different settings differ in size with the border 'valid': choose another")
    fidelity = Fidelity.preset(fidelity) if isinstance(fidelity, str) else fidelity
    widest = largest_window(optics.border, *image.shape[-2:])
    fidelity = replace(fidelity, max_window=min(fidelity.max_window, widest))
    camera = optics.with_fidelity(fidelity)
    camera.sensor = None
    camera.color_space = "paper" if fidelity.propagation == "paper" else "linear"  # neither decodes nor encodes
    # That of a wide defocus disc may be larger than the border allows.
    return camera if camera.window <= widest else camera.with_fidelity(replace(fidelity, window=widest))


def _touch(camera: TiDyOptics) -> None:
    """Invalidate the cached PSF bank, as a training step does, by adding zero to the masks."""
    with torch.no_grad():
        for phase in camera.masks.parameters():
            phase.add_(0)
