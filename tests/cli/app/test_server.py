"""The page's server, started as a user starts it, and asked by plain HTTP as other sites and programs would."""

from __future__ import annotations

import contextlib
import http.client
import importlib.util
import json
import os
import re
import signal
import socket
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

from tests.base import BaseTester

for package in ("gradio", "matplotlib"):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed", allow_module_level=True)

pytestmark = pytest.mark.slow
UPLOAD = "/gradio_api/upload"


@pytest.fixture(scope="module")
def temporary(tmp_path_factory):
    return tmp_path_factory.mktemp("temporary")


@pytest.fixture(scope="module")
def port(temporary):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    command = [sys.executable, "-m", "kornia_tidy", "app", "--port", str(number), "--allow-host", "lab.example"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, env={**os.environ, "TMPDIR": str(temporary)}, **pipes) as process:
        try:
            assert process.stdout.readline().split() == ["open", f"http://127.0.0.1:{number}/"]
            yield number
        finally:
            process.send_signal(signal.SIGINT)
            rest = process.stdout.read()
        assert process.wait() == 130
        assert rest.endswith("kornia-tidy: interrupted\n")
        assert "Traceback" not in rest
    assert [path.name for path in temporary.iterdir() if not path.name.startswith("torch")] == []


def ask(port, path="/config", method="GET", body=None, **headers):
    """Return status and body of an answer; names of headers are written with _, and paths are sent as they are."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
        connection.putrequest(method, path, skip_host=True)
        for name, value in {"host": f"127.0.0.1:{port}", **headers}.items():
            connection.putheader(name.replace("_", "-"), value)
        if body is not None and "content_length" not in headers:
            connection.putheader("content-length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, answer.read()


def upload(port, data, name="photo.png", **headers):
    head = f'--end\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'
    body = head.encode() + data + b"\r\n--end--\r\n"
    return ask(port, UPLOAD, "POST", body, content_type="multipart/form-data; boundary=end", **headers)


def answered(port, values):
    """Return what the page shows for values of its controls, as a browser asks for it: by the queue."""
    config = json.loads(ask(port)[1])
    show = max(config["dependencies"], key=lambda dependency: len(dependency["outputs"]))
    names = {each["id"]: each["props"].get("elem_id") for each in config["components"]}
    shown = {each["id"]: each["props"].get("value") for each in config["components"]}
    given = [values.get(names[number], shown[number]) for number in show["inputs"]]
    session = uuid.uuid4().hex
    wanted = {"data": given, "fn_index": show["id"], "session_hash": session, "trigger_id": show["inputs"][0]}
    asked = ask(port, "/gradio_api/queue/join", "POST", json.dumps(wanted).encode(), content_type="application/json")
    assert asked[0] == 200, asked
    _, events = ask(port, f"/gradio_api/queue/data?session_hash={session}")
    (last,) = [line for line in events.decode().splitlines() if '"process_completed"' in line]
    return json.loads(last.removeprefix("data: "))["output"]["data"]


class TestServer(BaseTester):
    def test_smoke_the_page_and_its_answers(self, port):
        status, page = ask(port, "/")
        assert status == 200
        assert b"gradio" in page
        message, scene, *_ = answered(port, {"noise": 1e-5, "side": 96})
        assert "Computed in" in message
        path = scene["value"]["path"] if "value" in scene else scene["path"]
        status, picture = ask(port, f"/gradio_api/file={path}")
        assert status == 200
        assert picture.startswith(b"\x89PNG")

    @pytest.mark.parametrize(
        "headers",
        [
            {"origin": "http://other.example"},
            {"origin": "null"},
            {"sec_fetch_site": "cross-site"},
            {"host": "other.example"},
        ],
        ids=str,
    )
    def test_exception_uploads_of_other_sites_store_nothing(self, headers, port, temporary):
        before = sorted(temporary.rglob("*"))
        assert upload(port, b"x", f"{uuid.uuid4()}.png", **headers)[0] in (403, 421)
        assert ask(port, UPLOAD, "OPTIONS", access_control_request_method="POST", **headers)[0] in (403, 421)
        assert sorted(temporary.rglob("*")) == before

    def test_feature_own_uploads_are_stored_and_read_back(self, port, temporary):
        for headers in ({}, {"origin": f"http://127.0.0.1:{port}"}):
            status, paths = upload(port, b"12345", **headers)
            assert status == 200
            (path,) = json.loads(paths)
            assert Path(path).is_relative_to(temporary)
            assert ask(port, f"/gradio_api/file={path}") == (200, b"12345")

    @pytest.mark.parametrize(
        "name", ["../../escaped.png", "/escaped.png", "..%2f..%2fescaped.png", "..\\..\\escaped.png"]
    )
    def test_feature_uploads_stay_in_their_folder(self, name, port, temporary):
        status, paths = upload(port, b"12345", name)
        if status == 200:
            (path,) = json.loads(paths)
            assert re.fullmatch(r"kornia-tidy-app-\w+/[0-9a-f]{64}/[^/]+", str(Path(path).relative_to(temporary)))
        assert not (temporary / "escaped.png").exists()
