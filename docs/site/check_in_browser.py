"""Open every page of the built site in a headless browser: pictures, links, search, and nothing wider than a phone.

    python docs/site/check_in_browser.py                    # outputs/site
    python docs/site/check_in_browser.py --shots outputs/shots   # and photographs some pages, light and dark

It needs `pip install playwright` and Chromium. Without them it says so and ends with status 0. It prints what is wrong,
and then ends with status 1.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import shutil
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

SITE = Path(__file__).resolve().parents[2] / "outputs" / "site"
SEARCHED = ("RandomDepthBlur", "lens")
SHOWN = ("index", "README", "docs/start", "docs/guides/augment", "gallery/index", "api/index")
WIDTHS = (1280, 390)  # pixels of a screen and of a phone
WAIT = 60_000  # milliseconds for a page or for the search
READ = """async () => {
    const pictures = [...document.images];
    pictures.forEach(picture => picture.loading = "eager");
    await Promise.all(pictures.filter(picture => !picture.complete).map(
        picture => new Promise(done => { picture.onload = picture.onerror = done; })));
    return {
        pictures: pictures.length,
        lost: pictures.filter(picture => !picture.naturalWidth).map(picture => picture.src),
        wordless: pictures.filter(picture => !picture.alt && picture.closest("article")).map(picture => picture.src),
        links: [...document.links].map(link => link.href),
        anchors: [...document.querySelectorAll("[id]")].map(element => element.id),
        beyond: document.documentElement.scrollWidth - window.innerWidth};
}"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what is wrong, and return 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--site", type=Path, default=SITE, help="folder of the site (outputs/site)")
    parser.add_argument("--shots", type=Path, help="folder for pictures of some pages")
    options = parser.parse_args(arguments)
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if find_spec("playwright") is None or browser is None:
        print("not checked: it needs playwright and Chromium")
        return 0
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with served(options.site) as base, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        wrong = check(chromium, base, options.site)
        if options.shots:
            photograph(chromium, base, options.shots)
    print(*wrong, sep="\n")
    return int(bool(wrong))


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder to this machine, and yield its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    port = server.server_port
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{port}/"
    server.shutdown()


def check(chromium: Any, base: str, folder: Path) -> list[str]:
    """Return what is wrong with the pages of a site."""
    page = chromium.new_page(viewport={"width": min(WIDTHS), "height": 844})
    page.set_default_timeout(WAIT)
    wrong, links, anchors, pictures = [], set(), {}, 0
    page.on("pageerror", lambda error: wrong.append(f"{page.url}: {error}"))
    page.on("response", lambda answer: answer.status < 400 or wrong.append(f"{answer.url}: status {answer.status}"))
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.html"))
    for name in names:
        page.goto(base + name)
        found = page.evaluate(READ)
        pictures += found["pictures"]
        anchors[name] = set(found["anchors"])
        links |= {(name, link) for link in found["links"] if link.startswith(base)}
        wrong += [f"{name}: no picture {picture}" for picture in found["lost"]]
        wrong += [f"{name}: no words for {picture}" for picture in found["wordless"]]
        if found["beyond"] > 0:
            wrong.append(f"{name}: {found['beyond']} pixels wider than a phone")
    for name, link in sorted(links):
        target, _, anchor = link.removeprefix(base).partition("#")
        target = target or "index.html"
        gone = target not in anchors if target.endswith(".html") else not (folder / target).exists()
        if gone or (anchor and anchor not in anchors.get(target, {anchor})):
            wrong.append(f"{name}: no {target}#{anchor}")
    for word in SEARCHED:
        page.goto(f"{base}search.html?q={word}")
        page.wait_for_selector("ul.search li a")
        print(f"search for {word}: {page.locator('ul.search > li').count()} pages or more")
    print(f"{len(names)} pages, {len(links)} links, {pictures} pictures")
    return wrong


def photograph(chromium: Any, base: str, folder: Path) -> None:
    """Write pictures of pages: their tops in both widths and themes."""
    folder.mkdir(parents=True, exist_ok=True)
    for width in WIDTHS:
        for theme in ("light", "dark"):
            page = chromium.new_page(viewport={"width": width, "height": 900}, color_scheme=theme)
            for name in SHOWN:
                page.goto(f"{base}{name}.html")
                page.screenshot(path=folder / f"{name.replace('/', '_')}_{width}_{theme}.png")
            page.close()


if __name__ == "__main__":
    sys.exit(main())
