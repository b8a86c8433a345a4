"""Guard of the page's server: which web sites may talk to it, how much they may store, and which files it hands out.

A browser sends requests of any page that it shows to this machine. The ``Origin`` shows a foreign page, the ``Host`` a
page with a name rebound to this machine.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

THIS_MACHINE = frozenset({"localhost", "127.0.0.1", "[::1]"})
HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:(?P<port>\d{1,5}))?")
LARGEST_UPLOAD, LARGEST_MESSAGE = 256 << 20, 1 << 20  # bytes of one request: files, and everything else
LARGEST_SUM = 1 << 30  # bytes of all files that are stored
UPLOAD, FILES = "/gradio_api/upload", re.compile(r"/gradio_api/file[=/](?P<path>.*)", re.DOTALL)
ELSEWHERE = ("/gradio_api/proxy=", "/gradio_api/run-history")  # Gradio's requests to other servers


def host_name(text: str) -> str:
    """Return the name of a host in the form of requests.

    Raises:
        ValueError: if it is not a name or address, or has a scheme or port.

    Example:
        >>> host_name("Lab.Example"), host_name("fe80::1")
        ('lab.example', '[fe80::1]')
    """
    try:
        return f"[{ipaddress.IPv6Address(text.strip('[]')).compressed}]"
    except ValueError:
        name = text.lower()
    found = HOST.fullmatch(name)
    if not found or found["port"]:
        raise ValueError(f"must be a name or an address without scheme and port, such as lab.example, got {text!r:.80}")
    return name


class Guard:
    """ASGI application around that of the page.

    Requests for other hosts get 421, those of other sites 403, too large ones 413. Uploads remove the oldest
    ones if all files together would be more than 1 GiB; files that were in the folder before stay.

    Args:
        application: of the page.
        folder: with all files that the page stores and hands out.
        hosts: names of this machine besides ``localhost``, ``127.0.0.1`` and ``[::1]``.
        largest_sum: bytes of all stored files.
    """

    def __init__(
        self, application: Application, folder: Path, hosts: Iterable[str] = (), largest_sum: int = LARGEST_SUM
    ) -> None:
        self.application = application
        self.folder = folder.resolve()
        self.named = frozenset(hosts)
        self.largest_sum = largest_sum
        self.expected = 0
        """Bytes of the requests that are being read."""
        self.kept = {path for path, _, _ in self._stored()}

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.application(scope, receive, send)
            return
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1").lower())
        refusal = self.refusal(scope["path"], headers)
        if refusal is not None:
            await _refuse(scope, send, *refusal)
        elif scope["type"] != "http" or scope["method"] in {"GET", "HEAD", "OPTIONS"}:
            await self.application(scope, receive, send)
        else:
            await self._receive_bounded(scope, headers, receive, send)

    def refusal(self, path: str, headers: dict[str, list[str]]) -> tuple[int, str] | None:
        """Return status and sentence with which a request is refused, or None.

        Args:
            path: of the address, decoded.
            headers: all values by name, both in lower case.
        """
        hosts, origins = headers.get("host", []), headers.get("origin", [])
        host = HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
        if host is None or host["name"] not in THIS_MACHINE | self.named:
            return 421, "this page has another address; kornia-tidy app --allow-host NAME allows one more"
        if len(origins) > 1 or (origins and not self._is_own(origins[0], host["port"])):
            return 403, "requests of other sites are refused"
        if any(site not in {"same-origin", "none"} for site in headers.get("sec-fetch-site", [])):
            return 403, "requests of other sites are refused: open the address in its own tab"
        if path.startswith(ELSEWHERE):
            return 403, "this page asks nothing of other servers"
        file = FILES.match(path)
        if file and not self._is_stored(file["path"]):
            return 403, "only files of this page can be read"
        return None

    def _is_own(self, origin: str, port: str | None) -> bool:
        """Return whether an origin is the page itself, under any name of this machine, or a site named by an option."""
        site = urlsplit(origin)
        found = HOST.fullmatch(site.netloc)
        if site.scheme not in {"http", "https"} or found is None or origin != f"{site.scheme}://{site.netloc}":
            return False
        return found["name"] in self.named or (found["name"] in THIS_MACHINE and found["port"] == port)

    def _is_stored(self, path: str) -> bool:
        try:
            return Path(path).is_absolute() and Path(path).resolve().is_relative_to(self.folder)
        except (OSError, ValueError):  # too long, or with a null byte
            return False

    def _stored(self) -> list[tuple[Path, int, float]]:
        """Return path, size and time of each file."""
        found = []
        for path in self.folder.rglob("*"):
            try:
                if not path.is_dir():
                    found.append((path, path.lstat().st_size, path.lstat().st_mtime))
            except FileNotFoundError:  # removed in the meantime
                continue
        return found

    def _make_room(self, size: int) -> bool:
        """Remove the oldest files until more bytes have room; return whether they do."""
        stored = self._stored()
        total = size + self.expected + sum(each for _, each, _ in stored)
        for path, each, _ in sorted(stored, key=lambda file: file[2]):
            if total <= self.largest_sum:
                break
            if path not in self.kept:
                path.unlink(missing_ok=True)
                total -= each
        return total <= self.largest_sum

    async def _receive_bounded(
        self, scope: MutableMapping[str, Any], headers: dict[str, list[str]], receive: Receive, send: Send
    ) -> None:
        """Pass a request on, as long as its body is small enough and there is room for it."""
        most = LARGEST_UPLOAD if scope["path"].rstrip("/") == UPLOAD else LARGEST_MESSAGE
        told = headers.get("content-length", [""])[0]
        in_chunks = most if "transfer-encoding" in headers else 0  # of unknown number
        size = int(told) if told.isdecimal() else in_chunks
        if size > most:
            await _refuse(scope, send, 413, f"a request must be at most {most} bytes, got {size}")
            return
        if not self._make_room(size):
            await _refuse(scope, send, 413, "there is no room for more files at the moment")
            return
        received, started, refused = 0, False, False

        async def bounded() -> Message:
            nonlocal received, refused
            message = await receive()
            received += len(message.get("body", b""))
            refused = refused or received > size
            return {"type": "http.disconnect"} if refused else message

        async def answer(message: Message) -> None:
            nonlocal started
            if not refused:
                started = True
                await send(message)

        self.expected += size
        try:
            await self.application(scope, bounded, answer)
        except Exception:
            if not refused:
                raise
        finally:
            self.expected -= size
        if refused and not started:
            await _refuse(scope, send, 413, f"a request must be at most {size} bytes")


async def _refuse(scope: MutableMapping[str, Any], send: Send, status: int, sentence: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": sentence[:100]})
        return
    text = f"{sentence}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(text)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": text})
