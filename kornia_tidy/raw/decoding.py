"""Decoding of camera raw files by LibRaw, in a process of its own: whatever a file does to it ends in one sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from io import SEEK_END
from pathlib import Path
from signal import Signals
from tempfile import TemporaryFile
from typing import IO, Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.files import check_file
from kornia_tidy.raw.decoder import C330_LENGTHS, LOADED
from kornia_tidy.raw.plausible import is_c330

Source = str | os.PathLike[str] | bytes | bytearray | memoryview | BinaryIO

DECODER = Path(__file__).with_name("decoder.py")
LONGEST_HEADER = 1 << 16
# How raw files begin, by where: TIFF and what is built like it, Canon, Fujifilm, Sigma, Minolta, Apple and others.
# LibRaw takes a file without any of these for a dump of the counts if its size is that of some camera's.
BEGINNINGS = {
    0: (
        b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FUJIFILM", b"FOVb", b"\0MRM",
        b"qktk", b"qktn", b"ARRI", b"NOKIARAW", b"PWAD", b"DSC-Image",
    ),
    4: (b"ftypcrx ",),
    6: (b"HEAPCCDR",),
}  # fmt: skip
SENTENCES = {
    "LibRawIOError": "it is damaged or cut short",
    "LibRawDataError": "its data are damaged, or of a kind that LibRaw does not decode",
    "LibRawFileUnsupportedError": "it is no raw file of a kind that LibRaw decodes",
    "LibRawRequestForNonexistentImageError": "it holds no raw picture",
    "LibRawTooBigError": "its picture is larger than LibRaw decodes",
}
# Where memory ends shows in the kind of an error or in its words: C++'s, the dynamic linker's, which loads NumPy and
# LibRaw under the limit too, and OpenBLAS's, which ends the process.
OUT_OF_MEMORY = ("MemoryError", "LibRawUnsufficientMemoryError", "LibRawMemPoolOverflowError")
OUT_OF_MEMORY_WORDS = (
    "MemoryError",
    "bad_alloc",
    "failed to map segment",
    "Cannot allocate memory",
    "Memory allocation still failed",
    "returned a result with an exception set",  # NumPy, as it is loaded
)


def decode_raw(source: Source, timeout: float, memory_limit: int) -> tuple[dict[str, Any], Tensor, int]:
    """Return what LibRaw knows of a raw file, its counts, (C, H, W) int32, and the file's length in bytes.

    Args:
        source: a path, the bytes of a file, or a binary file, which is read from where it stands.
        timeout: seconds that decoding may take.
        memory_limit: bytes that the decoding process may use.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be decoded, for whatever reason, within these limits.

    Warns:
        UserWarning: if its length alone says what it is.
    """
    check_positive("timeout", timeout, "seconds")
    check_positive("memory_limit", memory_limit, "bytes")
    name = source_name(source)
    with _opened(source) as file, TemporaryFile() as result:
        length = file.seek(0, SEEK_END)
        file.seek(0)
        beginning = file.read(16)
        if length in C330_LENGTHS and not begins_as_raw(beginning) and is_c330(beginning + file.read()):
            warnings.warn(
                f"{name} has no header: by its length of {length} bytes it is taken for a picture of a Kodak C330",
                stacklevel=3,
            )
        else:
            check_beginning(name, beginning)
        file.seek(0)  # where the process begins to read
        try:
            complaint = _complaint(*_run(file, result, timeout, memory_limit), memory_limit)
        except subprocess.TimeoutExpired:
            complaint = f"decoding took longer than {timeout:g} s"
        header = _header(result)
        if complaint is None and "error" in header:
            complaint = _sentence(header, memory_limit)
        if complaint is not None:
            raise ValueError(f"cannot read {name}: {complaint}")
        try:
            return header, _counts(result, header["shape"]), length
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"cannot read {name}: decoding it gave no complete picture") from None


def source_name(source: Source) -> str:
    """Return what to call a source in a sentence."""
    if isinstance(source, str | os.PathLike):
        return str(source)
    if isinstance(source, bytes | bytearray | memoryview):
        return f"the raw file of {len(source)} bytes"
    return str(getattr(source, "name", "the raw file"))


def source_bytes(source: Source) -> bytes:
    """Return all that a source holds.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder or empty.
    """
    with _opened(source) as file:
        data = file.read()
    if not data:
        raise ValueError(f"cannot read {source_name(source)}: the file is empty")
    return data


def check_beginning(name: str, data: bytes) -> None:
    """Refuse what does not begin as raw files do, before LibRaw guesses what it is from its size."""
    if not data:
        raise ValueError(f"cannot read {name}: the file is empty")
    if begins_as_raw(data):
        return
    if data.startswith((b"\xff\xd8\xff", b"\x89PNG")):
        raise ValueError(f"cannot read {name}: it is a JPEG or PNG picture, not a raw file")
    raise ValueError(
        f"cannot read {name}: it does not begin as raw files do; if it is a bare dump of the counts, give its size, "
        "data type, filter pattern, black and white levels"
    )


def begins_as_raw(data: bytes) -> bool:
    """Return whether bytes are the beginning of a raw file with a header."""
    return any(data.startswith(beginning, place) for place, all_ in BEGINNINGS.items() for beginning in all_)


@contextmanager
def _opened(source: Source) -> Generator[IO[bytes]]:
    """Give a source as a file of the system, unbuffered as another process will read it; bytes in a temporary one."""
    if isinstance(source, str | os.PathLike):
        path = check_file(source)
        if not path.is_file():
            raise ValueError(f"cannot read {path}: it is not a regular file")
        with path.open("rb", buffering=0) as file:
            yield file
        return
    data = source if isinstance(source, bytes | bytearray | memoryview) else source.read()
    if not isinstance(data, bytes | bytearray | memoryview):
        raise TypeError(f"a raw file must be a path, bytes or a binary file, got a file of {type(data).__name__}")
    with TemporaryFile(buffering=0) as file:
        file.write(data)
        file.seek(0)
        yield file


def _run(file: IO[bytes], result: IO[bytes], timeout: float, memory_limit: int) -> tuple[int, str]:
    """Let the decoder read one file and write the other; return its exit status and what it printed.

    Raises:
        subprocess.TimeoutExpired: if it took too long; it is dead by then.
    """
    arguments = [json.dumps(sys.path), str(int(timeout) + 1), str(int(memory_limit))]
    process = subprocess.run(  # noqa: S603 (our own interpreter and file)
        [sys.executable, "-I", "-S", str(DECODER), *arguments],
        stdin=file,
        stdout=result,
        stderr=subprocess.PIPE,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # threads that decode nothing, each with its stack
        timeout=timeout,
        check=False,
    )
    return process.returncode, process.stderr.decode(errors="replace")


def _complaint(status: int, printed: str, memory_limit: int) -> str | None:
    """Return what an exit status and printed words mean; None if all went well."""
    if status < 0:
        name = Signals(-status).name
        if name == "SIGXCPU":
            return "decoding it took more processor time than it may use"
        if LOADED not in printed.split():
            return f"its decoder crashed before it was loaded ({name}): is {_memory(memory_limit)} too little?"
        return f"LibRaw crashed on it ({name})"
    return _failure(printed, memory_limit) if status else None


def _header(result: IO[bytes]) -> dict[str, Any]:
    """Return the line of JSON that the decoder wrote, and leave the file at the counts behind it."""
    result.seek(0)
    try:
        header = json.loads(result.readline(LONGEST_HEADER))
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}


def _counts(result: IO[bytes], shape: list[int]) -> Tensor:
    height, width, channels = shape
    start = result.tell()
    if result.seek(0, SEEK_END) - start != 2 * height * width * channels:
        raise ValueError
    mapped = np.memmap(result, dtype=np.uint16, mode="r", offset=start, shape=(height, width, channels))
    counts = torch.empty(channels, height, width, dtype=torch.int32)  # small pages, see whole_numbers.py
    counts.numpy()[:] = mapped.transpose(2, 0, 1)
    return counts


def _sentence(header: dict[str, Any], memory_limit: int) -> str:
    """Return what an exception in the decoder means."""
    kind, text = str(header["error"]), str(header.get("text", ""))
    if kind in OUT_OF_MEMORY:
        return _too_much(memory_limit)
    if kind in SENTENCES:
        return SENTENCES[kind]
    return text if kind == "ValueError" else _failure(text or kind, memory_limit)


def _failure(text: str, memory_limit: int) -> str:
    """Return what the words of a decoder mean that did not come to an answer."""
    text = text.removeprefix(LOADED)
    if any(words in text for words in OUT_OF_MEMORY_WORDS):
        return _too_much(memory_limit)
    return f"its decoder failed ({' '.join(text.split())[-200:]})"


def _too_much(memory_limit: int) -> str:
    return f"decoding it needs more than {_memory(memory_limit)}"


def _memory(limit: int) -> str:
    return f"the {limit / 2**20:.0f} MiB of memory that it may use"
