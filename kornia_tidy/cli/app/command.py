"""`kornia-tidy app`: the interactive page, in a browser on this machine."""

from __future__ import annotations

import os
import socket
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from kornia_tidy.cli.app.guard import host_name
from kornia_tidy.cli.commands.parser import Parsed
from kornia_tidy.settings import Unit

HOST = "127.0.0.1"
FIRST_PORT, TRIED, PORTS = 7860, 100, range(1024, 65536)


@dataclass(frozen=True, kw_only=True)
class App:
    """An interactive page in the browser, on this machine.

    A scene, a camera and its masks are chosen on it. It shows masks, point spread functions
    (PSFs) over depth, the coded capture, the reconstruction and the depth. The settings can
    be saved as a Python script that takes the same capture. Only this machine can open the
    page, and other web sites in its browser cannot use it. Ctrl+C ends it.

    It needs: pip install 'kornia-tidy[app]'

    Args:
        port: of the page. None: the first free one from 7860 on.
        allow_host: names of the page in requests, besides localhost, 127.0.0.1 and [::1]. None: no others.

    Examples:
        kornia-tidy app                 then open the address that it prints
        kornia-tidy app --port 8080
        ssh -L 7860:localhost:7860 HOST   the page of another machine, at localhost:7860
        kornia-tidy app --allow-host lab.example    behind a proxy of that name
    """

    port: Annotated[int, Unit("N", "", PORTS[0], PORTS[-1])] | None = None
    allow_host: tuple[Annotated[str, Parsed("NAME", read=host_name)], ...] = ()

    def run(self) -> None:
        """Make the page, and serve it until it is interrupted.

        Raises:
            ImportError: if Gradio or matplotlib are missing.
            OSError: if the port is taken.
        """
        from kornia_tidy.cli.commands.report import progress_bar, tell
        from kornia_tidy.figures.style import require_matplotlib

        require_matplotlib()
        bar = progress_bar("app", total=100, bar_format="{desc}: {bar} {postfix}")

        def progress(share: float, stage: str) -> None:
            bar.update(round(100 * share) - bar.n)
            bar.set_postfix_str(stage)

        with tempfile.TemporaryDirectory(prefix="kornia-tidy-app-") as folder:
            with bar:
                progress(0.0, "Gradio")
                os.environ["GRADIO_TEMP_DIR"] = folder  # uploaded files too are removed at the end
                from kornia_tidy.cli.app import page as page_module  # it needs Gradio

                page = page_module.make_page(progress, Path(folder))
                progress(0.95, "server")
                server = page_module.make_server(page, Path(folder), self.allow_host)
            with listening(self.port) as opened:
                number = opened.getsockname()[1]
                tell("open", f"http://127.0.0.1:{number}/")
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
