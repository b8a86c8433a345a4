"""The command line: `kornia-tidy` with its commands, and the page in the browser (`app/`).

Arguments come in, files and lines of a report go out. Read ``command_line.py`` first, which finds the command and tells
its errors, then ``commands/info.py``.
"""

from kornia_tidy.cli.command_line import main

__all__ = ["main"]
