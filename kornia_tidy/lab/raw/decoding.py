"""Decoding of camera raw files by LibRaw in a separate process, with one error sentence for every failure."""

from __future__ import annotations

import json
import os
import subprocess
import sys
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
from kornia_tidy.files import check_file, parse_json
from kornia_tidy.lab.raw.decoder import LOADED
from kornia_tidy.search_path import ROOT, package_folders

Source = str | os.PathLike[str] | bytes | bytearray | memoryview | BinaryIO

DECODER = Path(__file__).absolute().with_name("decoder.py")
LONGEST_HEADER = 1 << 16
# First bytes of raw files, by their offset: TIFF and its relatives, Canon, Fujifilm, Sigma, Minolta, Apple and others.
# LibRaw guesses the camera of a file without any of these from its size.
BEGINNINGS = {
    0: (
        b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FUJIFILM", b"FOVb", b"\0MRM",
        b"qktk", b"qktn", b"ARRI", b"NOKIARAW", b"PWAD", b"DSC-Image",
    ),
    4: (b"ftypcrx ",),
    6: (b"HEAPCCDR",),
}  # fmt: skip
COUNTS = {"uint16": torch.int32, "int32": torch.int32, "float32": torch.float32}  # by the decoder's data type
SENTENCES = {
    "LibRawIOError": "it is damaged or cut short",
    "LibRawDataError": "its data are damaged, or of a kind that LibRaw does not decode",
    "LibRawFileUnsupportedError": "it is no raw file of a kind that LibRaw decodes",
    "LibRawRequestForNonexistentImageError": "it holds no raw picture",
    "LibRawTooBigError": "its picture is larger than LibRaw decodes",
}
# Signs of exhausted memory: exceptions of Python and LibRaw, and messages of C++, of the dynamic linker, which loads
# NumPy and LibRaw under the limit too, and of OpenBLAS, which ends the process.
OUT_OF_MEMORY = ("MemoryError", "LibRawUnsufficientMemoryError", "LibRawMemPoolOverflowError")
OUT_OF_MEMORY_WORDS = (
    "MemoryError",
    "bad_alloc",
    "failed to map segment",
    "Cannot allocate memory",
    "Memory allocation still failed",
    "returned a result with an exception set",  # NumPy during its import
)


def decode_raw(source: Source, timeout: float, memory_limit: int) -> tuple[dict[str, Any], Tensor, int]:
    """Decode a raw file into a header, the counts, (C, H, W) int32 or float32, and the file's length in bytes.

    Args:
        source: a path, the bytes of a file, or a binary file, which is read from its current position.
        timeout: seconds that decoding may take.
        memory_limit: bytes that the decoding process may use.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file cannot be decoded within these limits.
    """
    check_positive("timeout", timeout, "seconds")
    check_positive("memory_limit", memory_limit, "bytes")
    timeout, memory_limit = min(timeout, 1e6), min(memory_limit, 2**62)  # the system counts no further
    name = source_name(source)
    with _opened(source) as file, TemporaryFile() as result:
        length = file.seek(0, SEEK_END)
        file.seek(0)
        check_beginning(name, file.read(16))
        file.seek(0)  # the process reads from the current position
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
            return header, _counts(result, header["shape"], header["type"]), length
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"cannot read {name}: decoding it gave no complete picture") from None


def source_name(source: Source) -> str:
    """Return the name of a source for messages."""
    if isinstance(source, str | os.PathLike):
        return str(source)
    if isinstance(source, bytes | bytearray | memoryview):
        return f"the raw file of {len(source)} bytes"
    return str(getattr(source, "name", "the raw file"))


def source_bytes(source: Source) -> bytes:
    """Return the bytes of a source.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is a folder or empty.
    """
    with _opened(source) as file:
        data = file.read()
    if not data:
        raise ValueError(f"cannot read {source_name(source)}: the file is empty")
    return data


def check_beginning(name: str, data: bytes) -> None:
    """Raise ``ValueError`` unless the first bytes are those of a raw file, before LibRaw guesses from the size."""
    if not data:
        raise ValueError(f"cannot read {name}: the file is empty")
    if any(data.startswith(beginning, place) for place, all_ in BEGINNINGS.items() for beginning in all_):
        return
    if data.startswith((b"\xff\xd8\xff", b"\x89PNG")):
        raise ValueError(f"cannot read {name}: it is a JPEG or PNG picture, not a raw file")
    raise ValueError(
        f"cannot read {name}: it does not begin as raw files do; if it is a bare dump of the counts, give its size, "
        "data type, filter pattern, black and white levels"
    )


@contextmanager
def _opened(source: Source) -> Generator[IO[bytes]]:
    """Open a source as an unbuffered file for the decoder process; bytes go into a temporary file."""
    if isinstance(source, str | os.PathLike):
        path = check_file(source)
        if not path.is_file():
            raise ValueError(f"cannot read {path}: it is not a regular file")
        with path.open("rb", buffering=0) as file:
            yield file
        return
    read = getattr(source, "read", None)
    data: Any = source if read is None else read()
    if not isinstance(data, bytes | bytearray | memoryview):
        got = f"{'' if read is None else 'a file of '}{type(data).__name__}"
        raise TypeError(f"a raw file must be a path, bytes or a binary file, got {got}")
    with TemporaryFile(buffering=0) as file:
        file.write(data)
        file.seek(0)
        yield file


def _run(file: IO[bytes], result: IO[bytes], timeout: float, memory_limit: int) -> tuple[int, str]:
    """Run the decoder from one file into another; return its exit status and standard error.

    Raises:
        subprocess.TimeoutExpired: if it took too long; the process has been killed.
    """
    packages = package_folders("numpy", "rawpy")
    arguments = [json.dumps(packages), str(int(timeout) + 1), str(int(memory_limit))]
    process = subprocess.run(  # noqa: S603 (our own interpreter and file)
        [sys.executable, "-I", "-S", str(DECODER), *arguments],
        stdin=file,
        stdout=result,
        stderr=subprocess.PIPE,
        cwd=ROOT,  # files beside a raw file are not ours
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # idle threads would take memory for their stacks
        timeout=timeout,
        check=False,
    )
    return process.returncode, process.stderr.decode(errors="replace")


def _complaint(status: int, printed: str, memory_limit: int) -> str | None:
    """Return the failure behind an exit status and standard error, in words; None after success."""
    if status < 0:
        name = Signals(-status).name
        if name == "SIGXCPU":
            return "decoding it took more processor time than it may use"
        if LOADED not in printed.split():
            return f"its decoder crashed before it was loaded ({name}): is {_memory(memory_limit)} too little?"
        return f"LibRaw crashed on it ({name})"
    return _failure(printed, memory_limit) if status else None


def _header(result: IO[bytes]) -> dict[str, Any]:
    """Read the decoder's JSON header, and leave the file at the counts after it."""
    result.seek(0)
    try:
        header = parse_json(result.readline(LONGEST_HEADER))
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}


def _counts(result: IO[bytes], shape: list[int], kind: str) -> Tensor:
    height, width, channels = shape
    start, dtype = result.tell(), np.dtype(kind)
    if kind not in COUNTS or result.seek(0, SEEK_END) - start != dtype.itemsize * height * width * channels:
        raise ValueError
    mapped = np.memmap(result, dtype=dtype, mode="r", offset=start, shape=(height, width, channels))
    # Not allocated by NumPy: see quantised_demosaicing.py
    counts = torch.empty(channels, height, width, dtype=COUNTS[kind])
    counts.numpy()[:] = mapped.transpose(2, 0, 1)
    return counts


def _sentence(header: dict[str, Any], memory_limit: int) -> str:
    """Return the failure behind an exception in the decoder, in words."""
    kind, text = str(header["error"]), str(header.get("text", ""))
    if kind in OUT_OF_MEMORY:
        return _too_much(memory_limit)
    if kind in SENTENCES:
        return SENTENCES[kind]
    return text if kind == "ValueError" else _failure(text or kind, memory_limit)


def _failure(text: str, memory_limit: int) -> str:
    """Return the failure behind the messages of a decoder that ended without a result."""
    text = text.removeprefix(LOADED)
    if any(words in text for words in OUT_OF_MEMORY_WORDS):
        return _too_much(memory_limit)
    return f"its decoder failed ({' '.join(text.split())[-200:]})"


def _too_much(memory_limit: int) -> str:
    return f"decoding it needs more than {_memory(memory_limit)}"


def _memory(limit: int) -> str:
    return f"the {f'{limit / 2**20:.0f} MiB' if limit >= 1 << 20 else f'{limit} bytes'} of memory that it may use"
