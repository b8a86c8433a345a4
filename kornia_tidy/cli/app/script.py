"""Python script of a capture in the app: the same camera, scene and noise, as a user would write it."""

from __future__ import annotations

import json
import math
from pathlib import Path

from kornia_tidy.cli.app.capture import Result
from kornia_tidy.cli.app.settings import AS_SYSTEM, FILES, FLAT, IDEAL, OWN, Settings
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.pretrained import PRETRAINED

PLACES = {
    "torch": "",
    "ClosedFormHead": "kornia_tidy.reconstruction",
    "PixelwiseMask": "kornia_tidy",
    "SensorNoise": "kornia_tidy",
    "ThinLensCamera": "kornia_tidy",
    "TiDyOptics": "kornia_tidy",
    "chart": "kornia_tidy.cli.app.scenes",
    "dead_leaves": "kornia_tidy.data",
    "initial_heights": "kornia_tidy.masks",
    "load_pretrained": "kornia_tidy.reconstruction.pretrained",
    "metres": "kornia_tidy.reconstruction.tasks",
    "photographic_leaves": "kornia_tidy.data",
    "read_files": "kornia_tidy.cli.app.scenes",
    "restored_over_field": "kornia_tidy.reconstruction",
    "split_maps": "kornia_tidy.reconstruction.tasks",
    "stretched": "kornia_tidy.reconstruction.tasks",
    "update_psfs": "kornia_tidy.reconstruction.trained",
    "write_depth": "kornia_tidy.data",
    "write_image": "kornia_tidy.data",
}
"""Names that a script may use, and the module of each."""


_AT_ONCE = "    reconstruction = head(capture[None])[0]"
_OVER_FIELD = [
    "",
    "    def restore(part, psfs):  # by the PSFs of its place",
    "        head.closed_form.set_psfs(psfs)",
    "        return head(part)",
    "",
    "    given = capture[None], optics.psf_model, restore",
    "    reconstruction = restored_over_field(*given, center=optics.field_center)[0]",
]


def as_python(result: Result) -> str:
    """Return a script that takes the same capture and reconstructs it in the same way.

    Args:
        result: of :func:`~kornia_tidy.cli.app.capture.take_picture`.

    Returns:
        The text of the script. It writes ``capture.png`` and ``reconstruction.png``, and ``depth.npy`` in metres if the
        system estimates depth. Files of the scene are read from the folder in which it runs.

    Example:
        >>> from kornia_tidy.cli.app.capture import take_picture
        >>> script = as_python(take_picture(Settings(side=96)))
        >>> script.splitlines()[0].strip('"')
        'A coded capture with the settings of `kornia-tidy app`.'
    """
    settings = result.settings
    camera = own(settings, result.camera, result.optics.field_center) if settings.camera == OWN else known(settings)
    body = "\n\n".join([camera, scene(settings), capture(settings, result.estimate is not None)])
    return f'"""A coded capture with the settings of `kornia-tidy app`."""\n\n{imports(body)}\n\n{body}\n'


def known(settings: Settings) -> str:
    """Return the lines that make the camera of a trained or published system."""
    sensor = f"SensorNoise({settings.noise!r})"
    changed = settings.compositing != AS_SYSTEM
    if settings.camera in PRETRAINED:
        lines = [
            f"system = load_pretrained({_text(settings.camera)})",
            "optics = system.optics",
            f"optics.sensor = {sensor}  # standard deviation of the read noise, 1 is full scale",
        ]
        return "\n".join(lines + [f"optics.compositing = {_text(settings.compositing)}"] * changed)
    arguments = [_text(settings.camera), f"generator={_generator(settings.mask_seed)}", f"sensor={sensor}"]
    arguments += [f"compositing={_text(settings.compositing)}"] * changed
    return _call("optics = TiDyOptics.from_preset", arguments)


def own(settings: Settings, camera: ThinLensCamera, center: tuple[float, float]) -> str:
    """Return the lines that make the own camera; lengths in metres, the picture's place in pixels from the axis."""
    values = ("focal_length", "aperture_diameter", "focus_distance", "pixel_pitch")
    lens = [f"{name}={_number(float(getattr(camera, name)))}" for name in values]
    lens.append(f"depth_range=({', '.join(map(_number, camera.depth_range))})")
    if settings.start == FLAT:
        masks = 'PixelwiseMask(1, initial="flat")'
    elif settings.start == "noise":
        masks = f"PixelwiseMask({settings.masks}, generator={_generator(settings.mask_seed)})"
    else:
        heights = f"initial_heights({_text(settings.start)}, {_generator(settings.mask_seed)})"
        masks = f"PixelwiseMask(initial={heights}[:{settings.masks}])"
    compositing = "gather" if settings.compositing == AS_SYSTEM else settings.compositing
    made = ["masks", "camera", f"sensor=SensorNoise({settings.noise!r})", f"compositing={_text(compositing)}"]
    if settings.lens != IDEAL:
        made += [f"lens={_text(settings.lens)}", f"field_center={center}"]
    lines = [f"# f/{camera.f_number:.3g}; lengths in metres", _call("camera = ThinLensCamera", lens)]
    return "\n".join([*lines, f"masks = {masks}", _call("optics = TiDyOptics", made)])


def scene(settings: Settings) -> str:
    """Return the lines that make image and depth."""
    stretch = settings.stretch and settings.camera != OWN
    if settings.scene == FILES:
        files = [_text(Path(str(path)).name) for path in (settings.image_file, settings.depth_file)]
        options = [f"depth_scale={settings.depth_scale!r}", f"side={settings.side}"]
        read = _call("image, depth, valid = read_files", [*files, *options])
        return f"{read}\ndepth = stretched(depth, valid, optics.camera)" if stretch else read
    height, width = settings.painted_size
    depths = "optics.camera.depth_range" if stretch else f"({settings.near!r}, {settings.far!r})"
    arguments = [str(height), str(width), f"depth_range={depths}"]
    if settings.scene == "dead leaves":
        arguments += [f"num_leaves={settings.painted_leaves}", f"seed={settings.seed}"]
        return _call("image, depth = dead_leaves", arguments)
    if settings.scene == "photographic leaves":
        return _call("image, depth = photographic_leaves", [*arguments, f"seed={settings.seed}"])
    return _call("image, depth = chart", arguments)


def capture(settings: Settings, has_depth: bool) -> str:
    """Return the lines that take the capture, reconstruct it and write both."""
    lines = ["with torch.no_grad():"]
    lines.append(f"    capture = optics(image, depth, generator={_generator(settings.noise_seed)})")
    if settings.camera in PRETRAINED:
        lines.append("    update_psfs(system.head, optics)  # tells the network of the noise")
        lines.append("    maps = split_maps(system.settings.task, system.head(capture[None]))")
        lines.append('    reconstruction = maps["image"][0].clamp(0, 1)')
    else:
        lines += ["    head = ClosedFormHead()", "    update_psfs(head, optics)"]
        lines += _OVER_FIELD if settings.camera == OWN and settings.lens != IDEAL else [_AT_ONCE]
    lines += ['write_image("capture.png", capture)', 'write_image("reconstruction.png", reconstruction)']
    if has_depth:
        lines.append('write_depth("depth.npy", metres(optics.camera, maps["depth"][0]))')
    return "\n".join(lines)


def imports(body: str) -> str:
    """Return the import lines for the names that a script uses.

    Example:
        >>> print(imports("torch.rand(1); TiDyOptics(); chart(3, 4)"))
        import torch
        <BLANKLINE>
        from kornia_tidy import TiDyOptics
        from kornia_tidy.cli.app.scenes import chart
    """
    used: dict[str, list[str]] = {}
    for name, place in PLACES.items():
        if f"{name}(" in body or f"{name}." in body:
            used.setdefault(place, []).append(name)
    plain = [f"import {name}" for name in used.pop("", [])]
    rest = [f"from {place} import {', '.join(names)}" for place, names in sorted(used.items())]
    return "\n".join([*plain, "", *rest])


def _generator(seed: int) -> str:
    return f"torch.Generator().manual_seed({seed})"


def _number(value: float) -> str:
    return 'float("inf")' if math.isinf(value) else repr(value)


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _call(function: str, arguments: list[str]) -> str:
    """Return a call in one line, or with one line for each argument if it is long."""
    line = f"{function}({', '.join(arguments)})"
    if len(line) <= 100:
        return line
    return "\n".join([f"{function}(", *(f"    {argument}," for argument in arguments), ")"])
