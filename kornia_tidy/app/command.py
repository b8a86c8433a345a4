"""`kornia-tidy app`: the interactive page, in a browser on this machine."""

from __future__ import annotations

import argparse
import os
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kornia_tidy.app.guard import host_name
from kornia_tidy.commands.report import tell
from kornia_tidy.figures.style import require_matplotlib

DESCRIPTION = """\
Open a page for the browser on which a scene, a camera and its masks are chosen, and
which shows masks, point spread functions (PSFs) over depth, the coded capture, the
reconstruction and the depth. The settings can be saved as a Python script that takes
the same capture. Only this machine can open the page, and other web sites in its
browser cannot use it. Ctrl+C ends it.
"""

EPILOG = """\
It needs: pip install 'kornia-tidy[app]'

examples:
  kornia-tidy app                 then open the address that it prints
  kornia-tidy app --port 8080
  ssh -L 7860:localhost:7860 HOST   the page of another machine, at localhost:7860
  kornia-tidy app --allow-host lab.example    behind a proxy of that name
"""

HOST = "127.0.0.1"
FIRST_PORT, TRIED, PORTS = 7860, 100, range(1024, 65536)


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "app",
        help="an interactive page in the browser",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--port", type=port, metavar="N", help=f"of the page (default: the first free one from {FIRST_PORT} on)"
    )
    parser.add_argument(
        "--allow-host",
        type=host,
        metavar="NAME",
        action="append",
        default=[],
        help="name by which the page is asked for, besides localhost, 127.0.0.1 and [::1]; may be repeated",
    )


def host(text: str) -> str:
    """Parse the name of a host."""
    try:
        return host_name(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def port(text: str) -> int:
    """Parse the number of a port."""
    if not (text.isascii() and text.isdigit() and int(text[:9]) in PORTS):
        raise argparse.ArgumentTypeError(f"must be a whole number from {PORTS[0]} to {PORTS[-1]}, got {text!r:.40}")
    return int(text)


def run(args: argparse.Namespace) -> None:
    """Make the page, and serve it until it is interrupted.

    Raises:
        ImportError: if Gradio or matplotlib are missing.
        OSError: if the port is taken.
    """
    require_matplotlib()
    bar = tqdm(total=100, desc="app", bar_format="{desc}: {bar} {postfix}", file=sys.stderr, leave=False, disable=None)

    def progress(share: float, stage: str) -> None:
        bar.update(round(100 * share) - bar.n)
        bar.set_postfix_str(stage)

    with tempfile.TemporaryDirectory(prefix="kornia-tidy-app-") as folder:
        with bar:
            progress(0.0, "Gradio")
            os.environ["GRADIO_TEMP_DIR"] = folder  # uploaded files too are removed at the end
            from kornia_tidy.app import page as page_module  # noqa: PLC0415 it needs Gradio

            page = page_module.make_page(progress, Path(folder))
            progress(0.95, "server")
            server = page_module.make_server(page, Path(folder), args.allow_host)
        with listening(args.port) as opened:
            port = opened.getsockname()[1]
            tell("open", f"http://127.0.0.1:{port}/")
            tell("end", "Ctrl+C")
            server.run(sockets=[opened])


def listening(number: int | None) -> socket.socket:
    """Return a socket that listens on this machine only, at a port or at the first free one.

    Raises:
        OSError: if the port is taken.
    """
    for each in range(FIRST_PORT, FIRST_PORT + TRIED) if number is None else [number]:
        try:
            return socket.create_server((HOST, each))
        except OSError as error:
            taken = error
    raise OSError(f"cannot open port {number or FIRST_PORT}: give another one by --port") from taken
