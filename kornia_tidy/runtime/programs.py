"""Programs that the package starts: found in absolute folders of the path only, and run outside of the current folder.

The current folder may hold files that somebody else wrote, such as a downloaded data set. Nothing of it is executed,
even where ``$PATH`` has an empty or a relative entry.
"""

from __future__ import annotations

import os
import shutil
from typing import Any


def find_program(name: str) -> str | None:
    """Return the absolute path of a program, or None if there is none.

    Args:
        name: an absolute path, or a name that is looked up in the absolute folders of ``$PATH``.

    Example:
        >>> find_program("./gcc") is None
        True
    """
    found = shutil.which(name, path=_absolute_path())
    return found if found and os.path.isabs(found) else None  # which() takes "./gcc" as it stands


def outside() -> dict[str, Any]:
    """Return the options of :class:`subprocess.Popen` for a program that must not meet the current folder."""
    return {"cwd": os.path.abspath(os.sep), "env": {**os.environ, "PATH": _absolute_path()}}


def _absolute_path() -> str:
    return os.pathsep.join(folder for folder in os.get_exec_path() if os.path.isabs(folder))
