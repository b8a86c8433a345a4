"""Python script of a capture in the app: the same settings, given to the functions behind the page."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from kornia_tidy.cli.app.settings import Settings

SCRIPT = '''\
"""A coded capture with the settings of `kornia-tidy app`."""

from kornia_tidy.cli.app.capture import take_picture
from kornia_tidy.cli.app.settings import Settings
from kornia_tidy.data import write_depth, write_image
from kornia_tidy.reconstruction.tasks import metres

settings = Settings({arguments})
result = take_picture(settings)  # with the camera itself, result.optics
write_image("capture.png", result.capture)
write_image("reconstruction.png", result.image)
if result.estimate is not None:
    write_depth("depth.npy", metres(result.camera, result.estimate))
'''


def as_python(settings: Settings) -> str:
    """Return a script that takes the same capture and reconstructs it in the same way.

    Args:
        settings: of the capture. The script lists those that differ from the defaults, in SI units.

    Returns:
        The text of the script. It writes ``capture.png`` and ``reconstruction.png``, and ``depth.npy`` in metres if the
        system estimates depth. Files of the scene are read from the folder in which it runs.

    Example:
        >>> [line for line in as_python(Settings(side=96)).splitlines() if "side" in line]
        ['    side=96,']
    """
    values = {field.name: getattr(settings, field.name) for field in fields(Settings)}
    values |= {name: values[name] and Path(str(values[name])).name for name in ("image_file", "depth_file")}
    lines = [f"    {name}={value!r},\n" for name, value in values.items() if value != getattr(Settings, name)]
    return SCRIPT.format(arguments="".join(["\n", *lines] if lines else []))
