"""Systems that come with the package or came with it, scored under other conditions without further training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from examples.paper.cameras import F_NUMBER
from examples.paper.closed_forms import ClosedForms
from examples.paper.scenes import Budget, painted, real
from examples.paper.training import best_temperature, mean_scores, prefixed, system_of
from kornia_tidy import TiDyOptics
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained
from kornia_tidy.reconstruction.trained import TrainedSystem, load_trained
from kornia_tidy.sensor.exposure import exposed_sensor

EARLIER = Path(__file__).parent / "systems"
ELECTRONS = 57_000.0  # at f/17.6: a noise of 0.002 at a fifth of full scale, in which the systems were trained
SIZES = {"smoke": (64, 2, 0), "cpu": (128, 6, 4), "gpu": (256, 64, 35), "paper": (256, 419, 35)}
"""Side of the scenes in pixels, and the numbers of painted and of real ones, by scale."""


def load_shipped(name: str) -> TrainedSystem:
    """Return a system that comes with the package, or one that came with it when the experiments were run."""
    return load_pretrained(name) if name in PRETRAINED else load_trained(EARLIER / f"{name}.safetensors")


def shipped_scores(name: str, scale: str, **changed: Any) -> Mapping[str, float | str]:
    """Return the scores of a shipped system whose camera is changed, on painted and on real scenes.

    The network is as it was trained. The closed form is given the PSFs of the changed camera.

    Args:
        name: of the system, see :func:`load_shipped`.
        scale: of the experiment.
        **changed: arguments of :class:`~kornia_tidy.TiDyOptics` that differ from the shipped camera's.
    """
    shipped = load_shipped(name)
    optics, task = with_parts(shipped.optics, **changed), shipped.settings.task
    network = system_of(optics, shipped.head, shipped.settings, shipped.step)
    closed = system_of(optics, ClosedForms(optics, task), shipped.settings, 0)
    size, count, most = SIZES[scale]
    budget = Budget(size=size)
    if task != "edof":
        best_temperature(closed, painted(budget, "validation", min(8, count)))
    found: dict[str, float | str] = {"task": task}
    for where, scenes in {"painted": painted(budget, "test", count), "real": real(most, size)}.items():
        for what, system in (("network", network), ("closed", closed)):
            found |= prefixed(what, {f"{where}_{score}": value for score, value in mean_scores(system, scenes).items()})
    return found


def with_parts(optics: TiDyOptics, **changed: Any) -> TiDyOptics:
    """Return a camera like a shipped one with other parts, and the sensor of equal exposure time."""
    parts = {
        name: getattr(optics, name)
        for name in ("masks", "camera", "modulator", "fidelity", "compositing", "color_space", "border", "spectrum")
    }
    sensor = exposed_sensor(optics.camera.f_number, ELECTRONS, F_NUMBER)
    return TiDyOptics(**{**parts, "sensor": sensor, **changed}).requires_grad_(requires_grad=False)


def conditions(scale: str) -> str:
    """Return the scenes and the noise in words."""
    size, count, most = SIZES[scale]
    return f"{count} painted and {most} real scenes of {size} px, {ELECTRONS:g} electrons of white at f/{F_NUMBER}."
