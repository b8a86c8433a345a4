"""The page in a browser: the app is started as a user starts it, and used in headless Chromium."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.data import dead_leaves, write_depth, write_image
from tests.base import BaseTester

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), None)
WAIT = 60_000  # ms; a busy machine is slow

for package in ("gradio", "playwright", "matplotlib"):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed", allow_module_level=True)
if BROWSER is None:
    pytest.skip(f"there is no browser: none of {', '.join(BROWSERS)}", allow_module_level=True)

from playwright.sync_api import expect, sync_playwright  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The app in a process of its own, started by its command and ended as by Ctrl+C."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "kornia_tidy", "app", "--port", str(port)]
    temporary = tmp_path_factory.mktemp("temporary")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, env={**os.environ, "TMPDIR": str(temporary)}, **pipes) as process:
        try:
            line = process.stdout.readline()
            assert line.split() == ["open", f"http://127.0.0.1:{port}/"], line
            yield line.split()[1]
        finally:
            process.send_signal(signal.SIGINT)
            rest = process.stdout.read()
        assert "Traceback" not in rest
    assert [path.name for path in temporary.iterdir() if not path.name.startswith("torch")] == []


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser, address):
    context = browser.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
    page = context.new_page()
    page.set_default_timeout(WAIT)
    page.goto(address)
    expect(page.locator("#picture-psfs img")).to_be_visible(timeout=WAIT)
    yield page
    context.close()


def told(page, text):
    """Wait until the message holds a text, and return the message."""
    expect(page.locator("#status")).to_contain_text(text, timeout=WAIT)
    return page.locator("#status").inner_text()


def choose(page, name, label):
    page.locator(f"#{name} input").click()
    page.get_by_role("option", name=label, exact=True).click()


def picture(page, name):
    """Return the pixels of a picture on the page, RGB."""
    data = urlopen(page.locator(f"#picture-{name} img").get_attribute("src")).read()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


class TestPage(BaseTester):
    @pytest.mark.parametrize("size", [(1280, 900), (390, 844)], ids=["desktop", "phone"])
    def test_feature_all_pictures_fit_the_width_and_nothing_is_asked_of_the_network(self, browser, address, size):
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        asked = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(address)
        for name in ("scene", "capture", "image", "depth", "estimate", "psfs"):
            expect(page.locator(f"#picture-{name} img")).to_be_visible(timeout=WAIT)
            assert page.locator(f"#legend-{name}").inner_text().strip()
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= size[0]
        assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
        page.close()

    def test_feature_only_this_machine_can_open_it(self, address):
        port = int(re.search(r":(\d+)/", address)[1])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(("192.0.2.1", 9))  # sends nothing; tells the address of this machine to the others
            outside = probe.getsockname()[0]
        with socket.socket() as attempt:
            assert attempt.connect_ex((outside, port)) != 0

    def test_feature_files_are_uploaded_and_the_script_gives_the_picture_on_the_page(self, page, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        image, depth = dead_leaves(96, 128, depth_range=(0.5, 3.0), num_leaves=60)
        write_image("photo.png", image)
        write_depth("depth.png", depth, scale=0.001)
        write_depth("small.png", torch.ones(1, 48, 64), scale=0.001)

        choose(page, "scene", "your photo and depth map")
        told(page, "A photo is missing: upload both a photo and its depth map")
        page.locator("#image_file input[type=file]").set_input_files("photo.png")
        told(page, "The depth map of the photo is missing")
        page.locator("#depth_file input[type=file]").set_input_files("depth.png")
        message = told(page, "choose another unit")  # metres, where the file has millimetres
        assert message.startswith("The middle depth of depth.png would be")
        choose(page, "depth_scale", "millimetres")
        told(page, "Computed in")
        expect(page.locator("#legend-scene")).to_contain_text("128 x 96 pixels", timeout=WAIT)

        with page.expect_download() as download:
            page.locator("#save").click()
        assert download.value.suggested_filename == "capture.py"
        download.value.save_as(tmp_path / "capture.py")
        runpy.run_path("capture.py")
        written = cv2.imread("capture.png", cv2.IMREAD_COLOR)[..., ::-1]
        # Another process may choose another backend, whose last digits round to the next of 255 values here and there.
        assert np.abs(written.astype(int) - picture(page, "capture").astype(int)).max() <= 1

        page.locator("#depth_file button[aria-label='Clear']").click()
        told(page, "The depth map of the photo is missing")
        page.locator("#depth_file input[type=file]").set_input_files("small.png")
        assert "got 128 x 96 and 64 x 48 pixels" in told(page, "must have the same size")
