"""Take the picture of the page in the browser: `python docs/make_app_picture.py`, into docs/images/app.png.

It needs `pip install playwright`, Chromium and the extra `app`. `--width 390` shows the page as a phone does.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).parent / "images" / "app.png"
WAIT = 300_000  # milliseconds
WITHOUT_TIME = "text => { text.textContent = text.textContent.replace(/ Computed in .*/, '') }"
SCALE = 0.75  # pixels of the picture for one of the page


def main() -> None:
    """Start the app on port 7864, and take its picture when all of its pictures are there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=PICTURE, help="the picture")
    parser.add_argument("--width", type=int, default=1280, help="of the page in pixels (1280)")
    options = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    command = [sys.executable, "-m", "kornia_tidy", "app", "--port", "7864"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as app, sync_playwright() as playwright:  # noqa: S603
        try:
            assert app.stdout is not None
            address = app.stdout.readline().split()[-1]
            chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
            screen = {"width": options.width, "height": options.width}
            page = chromium.new_page(viewport=screen, device_scale_factor=SCALE)
            page.set_default_timeout(WAIT)
            page.goto(address)
            page.locator("#picture-psfs img").wait_for()
            page.wait_for_load_state("networkidle")
            page.get_by_text("Computed in").evaluate(WITHOUT_TIME)  # that of this machine, while it takes the picture
            page.screenshot(path=options.output)
        finally:
            app.send_signal(signal.SIGINT)


if __name__ == "__main__":
    main()
