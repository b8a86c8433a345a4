"""Model card of a trained system: data, steps, scores, use, limits, licence and citation, by its training's record."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.tasks import MAPS
from kornia_tidy.reconstruction.trained import TrainedSystem

SCORES = {
    "capture_psnr": "PSNR of the capture itself, dB",
    "image_psnr": "PSNR of the image, dB",
    "image_ssim": "SSIM of the image",
    "image_rmse": "RMSE of the image in [0, 1]",
    "depth_rmse": "RMSE of normalised inverse depth in [0, 1]",
    "depth_rmse_radians": "RMSE of defocus, radians",
    "depth_rmse_metres": "RMSE of depth, metres",
    "depth_abs_rel": "mean relative error of depth",
    "depth_log10": "mean log10 error of depth",
    "depth_delta1": "share of depths within 1.25",
    "depth_delta2": "share of depths within 1.25²",
    "depth_delta3": "share of depths within 1.25³",
    "depth_counted": "share of pixels scored in metres",
}
"""Names of scores, as evaluation writes them, and their meaning."""

_RUN = {
    "data": "data",
    "scenes": "scenes",
    "size": "side of a scene, pixels",
    "epochs": "epochs",
    "batch": "scenes in a batch",
    "lr": "learning rate of the network",
    "lr_metres": "learning rate of the masks, metres",
    "loss": "loss",
    "augment": "augmented",
    "precision": "precision of the network",
}
_ESTIMATES = {"image": "the image in focus everywhere", "depth": "depth"}
_PAINTED = {"dead-leaves": "dead leaves", "photographic-leaves": "leaves like photographs"}
_COLLAGES = "photo-collages"
_IDENTIFIER = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")

CITATION = """\
@inproceedings{shah2023tidy,
  title     = {{TiDy-PSFs}: Computational Imaging with Time-Averaged Dynamic Point-Spread-Functions},
  author    = {Shah, Sachin and Kulshrestha, Sakshum and Metzler, Christopher A.},
  booktitle = {Proceedings of the IEEE/CVF International Conference on Computer Vision (ICCV)},
  year      = {2023}
}"""


def model_card(system: TrainedSystem, title: str, license: str | None = None) -> str:  # noqa: A002
    """Return the model card of a trained system as Markdown with the Hugging Face Hub's metadata.

    Numbers come from the system's settings, from those of its run, and from its record. Missing facts are stated as
    unknown.

    Args:
        system: the system, with ``record["scores"]`` by test set and name where it was scored.
        title: heading.
        license: identifier of the weights' licence.

    Raises:
        ValueError: if the licence is not an identifier.

    Source: Mitchell et al., Model Cards for Model Reporting (FAT* 2019), for the sections.

    Example:
        >>> from kornia_tidy.reconstruction.pretrained import load_pretrained
        >>> model_card(load_pretrained("joint-uncertain"), "joint-uncertain", "apache-2.0").splitlines()[1:4]
        ['library_name: kornia_tidy', 'license: apache-2.0', 'pipeline_tag: depth-estimation']
    """
    check_license(license)
    settings = system.settings
    title = " ".join(title.split())
    estimates = " and ".join(_ESTIMATES[name] for name in MAPS[settings.task])
    sections = [
        _metadata(settings, license),
        f"# {title}\n\nA simulated camera with {_masks(system)} and a network that reconstructs {estimates} from one "
        f"of its captures. Camera and network belong together. Both were made with kornia_tidy.",
        f"## Use\n\n{_USE.format(title=title, maps=', '.join(MAPS[settings.task]))}",
        f"## Camera and network\n\n{_table(('setting', 'value'), _camera(system))}",
        f"## Training\n\n{_training(system)}",
        f"## Scores\n\n{_scores(system.record.get('scores'))}",
        f"## Intended use\n\n{_INTENDED}",
        "## Limits\n\n" + "\n".join(f"- {limit}" for limit in _limits(system)),
        f"## Licence\n\n{license or 'None is given: ask whoever published these weights.'}",
        f"## Citation\n\nThe method is of this paper:\n\n```bibtex\n{CITATION}\n```",
    ]
    return "\n\n".join(sections) + "\n"


def check_license(license: str | None) -> None:  # noqa: A002
    """Raise ``ValueError`` unless a licence is None or has the form of an identifier."""
    if license is not None and not (isinstance(license, str) and _IDENTIFIER.fullmatch(license)):
        raise ValueError(f"license must be an identifier such as 'apache-2.0' or 'cc-by-nc-4.0', got {license!r:.80}")


_USE = """\
```python
import torch
from kornia_tidy.reconstruction.hub import from_pretrained
from kornia_tidy.reconstruction.tasks import split_maps

system = from_pretrained("{title}")  # this folder, or OWNER/NAME on the Hub
with torch.no_grad():
    capture = system.optics(image, depth)  # (B, 3, H, W) in [0, 1], (B, 1, H, W) in metres; or a real capture
    maps = split_maps(system.settings.task, system.head(capture))  # by name: {maps}
```"""

_INTENDED = """\
Research on cameras with phase masks: comparing masks, networks and noise levels, as a start for training on other
scenes, and as an example. Real captures must come from the camera described above, with these masks. It is not meant
for decisions that touch people's safety, such as driving by its depth."""


def _metadata(settings: SystemSettings, license: str | None) -> str:  # noqa: A002
    tags = ["kornia_tidy", "computational-imaging", "phase-mask", "extended-depth-of-field", "depth-estimation"]
    lines = ["library_name: kornia_tidy"]
    lines += [f"license: {license}"] if license else []
    lines += [f"pipeline_tag: {'depth-estimation' if 'depth' in MAPS[settings.task] else 'image-to-image'}", "tags:"]
    return "\n".join(["---", *lines, *(f"- {tag}" for tag in tags), "---"])


def _masks(system: TrainedSystem) -> str:
    settings = system.settings
    if settings.measured:
        return "a camera whose PSFs were measured"
    if not settings.masks:
        return "a fixed Fresnel lens"
    if system.optics.masks.is_flat():
        return "a lens without masks"
    return f"{settings.masks} learnt phase mask{'s shown during one exposure' if settings.masks > 1 else ''}"


def _camera(system: TrainedSystem) -> list[tuple[str, str]]:
    settings = system.settings
    camera = settings.camera()
    near, far = camera.depth_range
    masks = "none" if system.optics.masks.is_flat() else str(settings.masks)
    masks, psfs = ("as they were measured",) * 2 if settings.measured else (masks, f"fidelity {settings.fidelity!r}")
    well = "" if settings.full_well is None else f", full well of {settings.full_well:.4g} electrons"
    return [
        ("task", settings.task),
        ("phase masks", masks),
        ("lens", f"{camera.focal_length * 1e3:.4g} mm, f/{camera.focal_length / camera.aperture_diameter:.3g}"),
        ("focused at", _distance(float(camera.focus_distance))),
        ("range of depth", f"{near:.4g} m to {_distance(far)}"),
        ("pixel pitch", f"{camera.pixel_pitch * 1e6:.4g} µm"),
        ("read noise", f"{settings.sigma:.4g} of full scale{well}"),
        ("PSFs", f"{psfs}, window {settings.window} pixels"),
        ("compositing", settings.compositing),
        ("network", f"{settings.head}, width {settings.width or 'by default'}"),
        ("begins from", _beginning(settings)),
        (
            "depths refocused to before the network",
            f"{settings.refocus}, each twice" if settings.fine else str(settings.refocus),
        ),
    ]


def _beginning(settings: SystemSettings) -> str:
    """Return the name of the image to which the network adds its result."""
    if settings.closed_form:
        return f"the closed form, with the filter {settings.inverse!r}"
    return "the capture" if settings.residual else "nothing"


def _distance(metres: float) -> str:
    return "infinity" if math.isinf(metres) else f"{metres:.4g} m"


def _training(system: TrainedSystem) -> str:
    rows = [
        ("steps of the optimiser", str(system.step)),
        ("seed", str(system.record.get("seed", system.settings.seed))),
    ]
    rows += [(label, _value(system.run[name])) for name, label in _RUN.items() if name in system.run]
    rows += [
        (name, _value(value))
        for name, value in system.record.items()
        if name not in {"scores", "seed"} and isinstance(value, (str, int, float))
    ]
    unknown = "\n\nWhich data it was trained on is unknown: it came without the settings of a run."
    return _table(("quantity", "value"), rows) + ("" if "data" in system.run else unknown)


def _scores(scores: Any) -> str:
    if not isinstance(scores, Mapping) or not scores:
        return "None are recorded. `kornia-tidy evaluate` measures them."
    sets = {str(name): values for name, values in scores.items() if isinstance(values, Mapping)}
    names = dict.fromkeys(name for values in sets.values() for name in values)
    rows = [(SCORES.get(name, name), *(_value(values.get(name, "")) for values in sets.values())) for name in names]
    return _table(("score", *sets), rows) + "\n\nEach is the mean over the scenes of a test set."


def _limits(system: TrainedSystem) -> list[str]:
    settings = system.settings
    near, far = settings.camera().depth_range
    data = system.run.get("data")
    limits = [
        "Captures of another lens, sensor or set of masks are not what the network was trained for.",
        _noise_seen(system),
        f"Depths nearer than {near:.4g} m"
        + ("" if math.isinf(far) else f" or farther than {far:.4g} m")
        + " are beyond the camera's range and are taken for its ends.",
        "Captures were simulated: thin lens, on-axis PSFs, one depth for each pixel, no motion.",
    ]
    if data in _PAINTED:
        limits.append(f"Its last training was on painted scenes ({_PAINTED[data]}). Photographs have other statistics.")
    if data == _COLLAGES:
        limits.append(
            "It was trained on collages of photographs, in which depth has nothing to do with what they show."
        )
    if "depth" in MAPS[settings.task]:
        sure = "It tells how sure it is." if settings.depth_classes else "The network does not tell how sure it is."
        limits.append(f"Depth is a guess in areas without texture. {sure}")
    return limits


def _noise_seen(system: TrainedSystem) -> str:
    """Return the noise of the training: that of the camera where masks and network learnt together, else a range."""
    noise = system.run.get("noise_range")
    if system.run.get("learn", "both") == "both" or not noise:
        seen = f"It was trained with a noise of {system.settings.sigma:.4g} of full scale."
        return f"{seen} Other noise was not seen in training."
    least, largest = noise
    return f"Half of its training had a noise of {least:.4g} to {largest:.4g} of full scale, half had shot noise."


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    cells = [[" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in (header, *rows)]
    cells.insert(1, ["---"] * len(cells[0]))
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)
