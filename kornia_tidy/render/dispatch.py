"""The choice of a backend: a rule, or the one asked for by name."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kornia_tidy.checks import check_choice
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.render.backend import Backend, Work, wants_gradient
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.backends.compiled import CompiledBackend
from kornia_tidy.render.backends.dense import DenseBackend
from kornia_tidy.render.scene import LayeredScene

BACKENDS: dict[str, Backend] = {
    backend.name: backend for backend in (DenseBackend(), CompiledBackend(), BatchedBackend())
}
# What method= took before.
RENAMED = {"direct": "compiled", "overlap": "compiled", "tiled": "batched", "triton": "batched"}
# Where dense is the faster one: occlusion in C takes P^2 operations a pixel, and tiles of a small image through large
# PSFs are as large as it. It is taken while an image with all channels has few bytes in float64.
LARGEST_OCCLUSION, LARGEST_SHARE, LARGEST_PLANE = 65, 1 / 4, 32 << 20


def choose(scene: LayeredScene, method: str = "auto") -> Backend:
    """Return the backend that renders a scene.

    Transforms of torch are for dense alone. Accelerators take batched. Processors take compiled, and batched without a
    compiler; large PSFs go densely where that is faster, while the planes are small and no gradients are wanted, for
    which dense keeps every spectrum.

    Args:
        scene: to be rendered.
        method: ``"auto"``, or the name of the backend.

    Raises:
        ValueError: if the method is not known, or does not support the scene.
    """
    if method != "auto":
        return _named(scene, method)
    if Mode.TRANSFORM in torch_mode():
        return BACKENDS["dense"]
    if scene.image.device.type != "cpu":
        return BACKENDS["batched"]
    side = scene.psfs.shape[-1]
    if BACKENDS["compiled"].refusal(scene) is None:
        name, large = "compiled", scene.compositing == "occlusion" and side > LARGEST_OCCLUSION
    else:
        name, large = "batched", side >= LARGEST_SHARE * min(scene.output_size)
    return BACKENDS["dense" if large and _keeps_little(scene) else name]


def _keeps_little(scene: LayeredScene) -> bool:
    """Return whether dense rendering takes little memory: for gradients it keeps a spectrum of each layer."""
    inputs = scene.image, scene.layer_weight, scene.psfs, scene.stray_light
    recorded = torch.is_grad_enabled() and any(wants_gradient(x) for x in inputs)
    return not recorded and 8 * scene.image.numel() <= LARGEST_PLANE


def _named(scene: LayeredScene, method: str) -> Backend:
    if method in RENAMED:
        raise ValueError(f"method {method!r} is now {RENAMED[method]!r}, or 'auto' for the backend that suits a scene")
    check_choice("method", method, ("auto", *BACKENDS))
    if (why := refusal(BACKENDS[method], scene)) is not None:
        raise ValueError(f"method {method!r} does not support this scene: {why}; method='auto' takes one that does")
    return BACKENDS[method]


def refusal(backend: Backend, scene: LayeredScene) -> str | None:
    """Return why a backend does not support a scene, or None if it does."""
    if backend.name != "dense" and Mode.TRANSFORM in torch_mode():
        return "torch.func and forward-mode derivatives need plain operations of torch"
    return backend.refusal(scene)


@dataclass(frozen=True)
class Explanation:
    """Which backend renders a scene, and what the others would do, see :func:`explain`.

    Args:
        scene: the scene in words.
        backend: name of the one that ``method="auto"`` takes.
        works: work of each backend that supports the scene, by name.
        objections: why a backend does not support the scene, by name.
    """

    scene: str
    backend: str
    works: dict[str, Work]
    objections: dict[str, str]

    def __str__(self) -> str:
        first = sorted(self.works, key=lambda name: name != self.backend)
        words = {name: str(self.works[name]) for name in first} | self.objections
        return "\n".join([f"{self.scene}: {self.backend}", *(f"  {name}: {why}" for name, why in words.items())])


def explain(scene: LayeredScene) -> Explanation:
    """Return the choice of ``method="auto"`` for a scene, with the work of each backend or why it does not do it.

    Args:
        scene: from :func:`kornia_tidy.render.scene.layered_scene`.

    Example:
        >>> import torch
        >>> from kornia_tidy.render.scene import layered_scene
        >>> image, psi, nodes = torch.rand(1, 3, 64, 64), torch.zeros(1, 1, 64, 64), torch.tensor([0.0, 4.0])
        >>> print(explain(layered_scene(image, psi, nodes, torch.rand(2, 3, 23, 23))))  # doctest: +ELLIPSIS
        gather of 1 x 3 channels of 64x64 px, 1 of 2 layers, PSFs of 23x23 px: ...
    """
    (height, width), (batch, channels), side = scene.output_size, scene.image.shape[:2], scene.psfs.shape[-1]
    words = (
        f"{scene.compositing} of {batch} x {channels} channels of {height}x{width} px, {scene.sampled_layers} of "
        f"{len(scene.psfs)} layers, PSFs of {side}x{side} px"
    )
    objections = {name: why for name, backend in BACKENDS.items() if (why := refusal(backend, scene)) is not None}
    works = {name: backend.work(scene) for name, backend in BACKENDS.items() if name not in objections}
    return Explanation(words, choose(scene).name, works, objections)
