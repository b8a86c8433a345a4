"""Addresses outside the repository, in pages, docstrings and settings: https, of reviewed hosts, nothing asked of them.

A new address wants a look at what is there and, if its host is new, a line in the list below. What the addresses hold
today is asked by `make docs ARGS=--linkcheck`, with a network. Last looked at on 23 November 2026, in stored copies of
public pages: 2303.17583 is TiDy-PSFs, by Shah, Kulshrestha and Metzler.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import pytest

from tests.base import BaseTester

ROOT = Path(__file__).resolve().parents[1]
HOSTS = {
    "arxiv.org": r"/abs/\d{4}\.\d{5}",
    "download.pytorch.org": r"/whl/cpu",
    "git-lfs.github.com": r"/spec/",
    "horatio.cs.nyu.edu": r"/mit/silberman/.+\.mat",
    "lmb.informatik.uni-freiburg.de": r"/resources/datasets/\w+\.en\.html",
    "semver.org": r"/",
}  # each reviewed host, and the form that its addresses have
ADDRESS = re.compile(r"\b\w+://[^\s\"'<>`|]+")
BARE = re.compile(
    r"(?<![\w./@-])(?:www\.[\w.-]+|(?:github|gitlab|huggingface|arxiv|doi|pypi)\.(?:com|org|co))/[^\s\"'<>`|]+"
)
LOCAL = re.compile(r"https?://(?:127\.0\.0\.1|localhost)(?::(?:\d+|\{\w+\}))?(?:/|$)")
SUFFIXES = {".md", ".py", ".rst", ".toml", ".cff", ".ipynb", ".json", ".css", ".txt"}


class Address(NamedTuple):
    """An address and the line that it stands in."""

    place: str
    text: str


def files() -> list[Path]:
    """Return the files whose addresses a user meets."""
    folders = [path for name in ("docs", "kornia_tidy", "examples") for path in sorted((ROOT / name).rglob("*"))]
    return [path for path in [*sorted(ROOT.glob("*")), *folders] if path.suffix in SUFFIXES and path.is_file()]


def addresses(name: str, text: str) -> list[Address]:
    """Return the addresses in a text, without those of the reader's own machine; a bare one is returned as it is."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        for match in [*ADDRESS.findall(line), *BARE.findall(ADDRESS.sub("", line))]:
            address = match.rstrip(".,;:*")
            while address.endswith((")", "]", "}")) and address.count(address[-1]) > address.count(
                "([{"[")]}".index(address[-1])]
            ):
                address = address[:-1].rstrip(".,;:")
            if not LOCAL.match(address):
                found.append(Address(f"{name}:{number}", address))
    return found


def check(address: Address) -> None:
    """Raise an error for an address that is not https, or of a host or form that nobody has reviewed."""
    parts = urlsplit(address.text)
    assert parts.scheme == "https", f"{address.place}: {address.text} must begin with https://"
    assert parts.hostname in HOSTS, f"{address.place}: nobody has reviewed the host of {address.text}"
    assert re.fullmatch(HOSTS[parts.hostname], parts.path), (
        f"{address.place}: {address.text} is no address of that host"
    )


class TestAddresses(BaseTester):
    def test_feature_all_are_https_of_reviewed_hosts(self):
        found = [each for path in files() for each in addresses(str(path.relative_to(ROOT)), path.read_text("utf-8"))]
        assert len(found) > len(HOSTS)
        for address in found:
            check(address)
        assert {urlsplit(address.text).hostname for address in found} == set(HOSTS), "a reviewed host is not used"

    @pytest.mark.parametrize(
        ("text", "match"),
        [
            ("see http://arxiv.org/abs/2303.17583", "p.md:1: http://arxiv.org/abs/2303.17583 must begin with https"),
            ("[a](https://arxiv.org/abs/2303.1758)", "is no address of that host"),
            ("<https://example.com/x>.", "nobody has reviewed the host of https://example.com/x\n"),
            ("(github.com/kornia/kornia)", "must begin with https"),
            ("www.example.com/page", "must begin with https"),
            ("https://github.com/kornia/gone.", "nobody has reviewed the host of https://github.com/kornia/gone\n"),
        ],
    )
    def test_exception_names_the_line_and_the_address(self, text, match):
        (address,) = addresses("p.md", text)
        with pytest.raises(AssertionError, match=match):
            check(address)
