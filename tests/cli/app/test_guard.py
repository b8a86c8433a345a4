"""The guard of the page's server, around an application that stores what it gets: no server and no Gradio."""

from __future__ import annotations

import asyncio
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy.cli.app import guard as module
from kornia_tidy.cli.app.guard import Guard, host_name
from tests.base import BaseTester

UPLOAD = "/gradio_api/upload"
OWN = ("127.0.0.1:7860", "localhost:7860", "[::1]:7860", "localhost", "LOCALHOST:1", "lab.example", "lab.example:443")
FOREIGN_HOSTS = (
    *("other.example", "other.example:7860", "127.0.0.1.other.example", "localhost.other.example", "xlocalhost"),
    *("", "0.0.0.0:7860", "192.168.0.7:7860", "localhost:", "localhost:7860:1", "user@localhost", "localhost/x"),
    *("[::2]", "::1", "lab.example.other"),
)
FOREIGN_ORIGINS = (
    *("http://other.example", "null", "http://localhost:3000", "http://localhost", "file://", "", "localhost:7860"),
    *("http://127.0.0.1:7860.other.example", "http://other.example@127.0.0.1:7860", "ftp://127.0.0.1:7860"),
    *("http://127.0.0.1:7860/", "http://127.0.0.1:7860#", "http://[::2]:7860"),
)


class Stored:
    """An application that writes each body to a file of its own, as it comes in."""

    def __init__(self, folder):
        self.folder, self.count = folder, 0

    async def __call__(self, scope, receive, send):
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            return
        self.count += 1
        path, more = self.folder / f"{self.count}.bin", True
        with path.open("wb") as file:
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    raise ConnectionError
                file.write(message["body"])
                more = message["more_body"]
        os.utime(path, (self.count, self.count))
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})


def asked(guard, path="/", method="GET", body=(b"",), kind="http", **headers):
    """Return the status of a request to a guarded application; names of headers are written with _."""
    pairs = {"host": "127.0.0.1:7860", **{name.replace("_", "-"): value for name, value in headers.items()}}
    encoded = [(name.encode(), value.encode()) for name, value in pairs.items() if value is not None]
    sent, parts = [], list(body)

    async def receive():
        part = parts.pop(0)
        return {"type": "http.request", "body": part, "more_body": bool(parts)}

    async def send(message):
        sent.append(message)

    asyncio.run(guard({"type": kind, "path": path, "method": method, "headers": encoded}, receive, send))
    first = sent[0]
    return first["status"] if kind == "http" else first["type"]


@pytest.fixture
def guard(tmp_path):
    return Guard(Stored(tmp_path), tmp_path, ["lab.example"], largest_sum=1000)


class TestGuard(BaseTester):
    @pytest.mark.parametrize("host", OWN)
    def test_feature_own_hosts_are_served_at_any_port(self, host, guard):
        assert asked(guard, host=host) == 200

    @pytest.mark.parametrize("host", [*FOREIGN_HOSTS, None])
    def test_exception_other_hosts(self, host, guard):
        assert asked(guard, host=host) == 421
        assert asked(guard, host=host, kind="websocket") == "websocket.close"

    @given(host=st.text(st.characters(max_codepoint=255), max_size=30))
    def test_property_a_host_that_is_not_listed_is_refused(self, host):
        name = host.lower().rpartition(":")[0] if host[-1:].isdigit() and ":" in host else host.lower()
        own = {"localhost", "127.0.0.1", "[::1]"}
        guard = Guard(Stored(None), module.Path("/nowhere"))
        assert (guard.refusal("/", {"host": [host.lower()]}) is None) <= (name in own)

    @pytest.mark.parametrize("method", ["GET", "HEAD", "OPTIONS", "POST", "PUT", "DELETE", "PATCH", "TRACE"])
    @pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
    def test_exception_other_origins(self, origin, method, guard):
        assert asked(guard, UPLOAD, method, origin=origin) == 403
        assert asked(guard, origin=origin, kind="websocket") == "websocket.close"

    @pytest.mark.parametrize("origin", ["http://127.0.0.1:7860", "HTTP://LOCALHOST:7860", "https://lab.example", None])
    def test_feature_the_page_itself_may_ask_by_each_of_its_names(self, origin, guard):
        assert asked(guard, UPLOAD, "POST", origin=origin) == 200
        assert asked(guard, origin=origin, kind="websocket") == "websocket.accept"

    @pytest.mark.parametrize(
        ("site", "status"), [("cross-site", 403), ("same-site", 403), ("same-origin", 200), ("none", 200)]
    )
    def test_exception_other_sites_without_an_origin(self, site, status, guard):
        """As of pictures and of forms in a foreign page."""
        assert asked(guard, sec_fetch_site=site) == status

    @pytest.mark.parametrize("separator", "=/")
    def test_exception_files_elsewhere(self, separator, guard, tmp_path):
        (tmp_path / "mine.png").write_bytes(b"")
        (tmp_path / "link").symlink_to("/etc/passwd")
        file = f"/gradio_api/file{separator}"
        assert asked(guard, f"{file}{tmp_path}/mine.png") == 200
        elsewhere = (
            "/etc/passwd",
            f"{tmp_path}/../x",
            f"{tmp_path}/link",
            "x",
            ".",
            "",
            "http://other.example",
            "/\0",
            "/" + "x" * 5000,
        )
        assert {asked(guard, file + path) for path in elsewhere} == {403}
        assert asked(guard, "/gradio_api/proxy=http://other.example") == 403


class TestSums(BaseTester):
    def sizes(self, folder):
        return {path.name: path.stat().st_size for path in folder.iterdir()}

    def test_feature_the_oldest_uploads_make_room(self, guard, tmp_path):
        for _ in range(7):
            assert asked(guard, UPLOAD, "POST", [b"x" * 200, b"x" * 100], content_length="300") == 200
        assert self.sizes(tmp_path) == {f"{number}.bin": 300 for number in (5, 6, 7)}

    def test_feature_what_was_there_before_stays(self, tmp_path):
        (tmp_path / "first.png").write_bytes(b"x" * 900)
        guard = Guard(Stored(tmp_path), tmp_path, largest_sum=1000)
        assert asked(guard, UPLOAD, "POST", [b"x" * 100], content_length="100") == 200
        assert asked(guard, UPLOAD, "POST", [b"x" * 101], content_length="101") == 413
        assert self.sizes(tmp_path) == {"first.png": 900}

    @pytest.mark.parametrize(
        "told", [{"content_length": "50"}, {"content_length": "0"}, {}, {"transfer_encoding": "chunked"}], ids=str
    )
    def test_exception_more_than_was_told(self, told, guard, tmp_path, monkeypatch):
        """A body in chunks is stopped in the middle."""
        monkeypatch.setattr(module, "LARGEST_UPLOAD", 80)
        assert asked(guard, UPLOAD, "POST", [b"x" * 40] * 3, **told) == 413
        assert sum(self.sizes(tmp_path).values()) <= 80
        assert guard.expected == 0

    def test_exception_a_single_request(self, guard):
        assert asked(guard, UPLOAD, "POST", content_length=str(module.LARGEST_UPLOAD + 1)) == 413
        assert asked(guard, "/gradio_api/queue/join", "POST", content_length=str(module.LARGEST_MESSAGE + 1)) == 413

    def test_feature_requests_at_the_same_time_count(self, guard):
        guard.expected = 950
        assert asked(guard, UPLOAD, "POST", [b"x" * 60], content_length="60") == 413
        assert asked(guard, UPLOAD, "POST", [b"x" * 40], content_length="40") == 200

    def test_feature_an_error_of_the_application_is_not_hidden(self, tmp_path):
        async def fail(*_):
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            asked(Guard(fail, tmp_path), UPLOAD, "POST", content_length="1")


class TestHostName(BaseTester):
    @pytest.mark.parametrize(
        ("text", "name"), [("Lab.Example", "lab.example"), ("10.0.0.7", "10.0.0.7"), ("[FE80::1]", "[fe80::1]")]
    )
    def test_feature_as_it_stands_in_requests(self, text, name):
        assert host_name(text) == name

    @pytest.mark.parametrize(
        "text", ["", "*", "http://lab.example", "lab.example:80", "lab example", "lab.example/x", "é"]
    )
    def test_exception_no_name(self, text):
        with pytest.raises(ValueError, match="must be a name or an address without scheme and port"):
            host_name(text)
