"""File input and output: errors of one sentence, text in any Unicode form, atomic writes, and locks of folders.

No package is used for atomic writes: atomicwrites is unmaintained, and writes no folders.
"""

from __future__ import annotations

import codecs
import csv
import errno
import io
import json
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Any
from uuid import uuid4

try:
    import fcntl
except ImportError:  # missing on Windows, where nothing is locked
    fcntl = None

LONGEST_JSON, DEEPEST_JSON, MOST_DIGITS = 1 << 23, 100, 300
# By the mark at the beginning of a file. Excel and old editors of Windows write the first, a > of PowerShell 5 the last
# but one. The marks of UTF-32 are looked for before those of UTF-16, which they begin with.
_ENCODINGS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_HIDDEN = ("__macosx", "@eadir", "thumbs.db", "ehthumbs.db", "desktop.ini")  # besides names that begin with a dot
_POINTER = b"version https://git-lfs.github.com/spec/"
_LEFTOVER = re.compile(r"\.[0-9a-f]{32}\.tmp")  # temporary names of files and folders until they are complete


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read a whole file.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a regular file, is empty, a pointer of Git LFS, or is larger than the memory.
    """
    path = check_file(path)
    try:
        data = path.read_bytes()
    except MemoryError:
        raise ValueError(f"cannot read {path}: its {path.stat().st_size} bytes are more than the memory") from None
    except OSError as error:  # of a disk or a network drive names no file
        raise type(error)(f"cannot read {path}: {error.strerror or error}") from None
    if not data:
        raise ValueError(f"cannot read {path}: the file is empty")
    if data.startswith(_POINTER):
        raise ValueError(f"cannot read {path}: it is a pointer of Git LFS to the file, which git lfs pull fetches")
    return data


def check_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of an existing file.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is a folder, or no regular file: a pipe or a device might never end; or if no file can have
            this name.
    """
    path = Path(path)
    if _is_folder(path, "read"):
        raise ValueError(f"cannot read {path}: it is a folder")
    if not path.exists():
        raise FileNotFoundError(f"cannot read {path}: there is no such file")
    if not path.is_file():
        raise ValueError(f"cannot read {path}: it is not a regular file")
    return path


def _is_folder(path: Path, verb: str) -> bool:
    """Return whether a path is a folder; refuse names that are too long for the system."""
    try:
        return path.is_dir()
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        raise ValueError(f"cannot {verb} {str(path)[:100]}...: the name is too long") from None


def check_folder(path: str | os.PathLike[str]) -> Path:
    """Return the path of an existing folder.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"there is no folder {path}")
    return path


def output_folder(path: str | os.PathLike[str]) -> Path:
    """Return the path of a folder to write into, which may be missing.

    Raises:
        ValueError: if something else has its name.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise ValueError(f"cannot write into {path}: it is not a folder")
    return path


def read_text(path: str | os.PathLike[str], errors: str = "strict") -> str:
    r"""Read a text file in UTF-8, or in UTF-8, UTF-16 or UTF-32 with a byte order mark, which is left out.

    Args:
        path: of the file.
        errors: how to treat bytes that are not text, as for ``bytes.decode``.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a text.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "list.txt").write_text("rgb/1.png", encoding="utf-16")
        ...     read_text(f"{folder}/list.txt")
        'rgb/1.png'
    """
    data = read_bytes(path)
    encoding = next((name for mark, name in _ENCODINGS.items() if data.startswith(mark)), "utf-8")
    try:
        return data.decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise ValueError(f"cannot read {path}: it is no text in {encoding[:6].strip('-').upper()} ({error})") from None


def find_files(root: str | os.PathLike[str], pattern: str) -> Iterator[Path]:
    """Yield the files below a folder that a pattern of ``Path.glob`` names, in any order.

    Convention:
        Hidden files and those in hidden folders are passed by, as a shell's ``*`` does: names that begin with a dot,
        unless the pattern has the dot. macOS leaves ``._name`` beside each file on drives of other systems, and in the
        folder ``__MACOSX`` of archives. That, what Windows hides, such as ``Thumbs.db``, and the thumbnails that
        network drives keep in ``@eaDir`` are also ignored.
    """
    dotted = [part for part in PurePath(pattern).parts if part.startswith(".")]
    for path in Path(root).glob(pattern):
        hidden = [part for part in path.relative_to(root).parts if part.startswith(".") or part.lower() in _HIDDEN]
        if all(any(fnmatchcase(part, wanted) for wanted in dotted) for part in hidden) and path.is_file():
            yield path


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a file of JSON.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not JSON, or is nested too deep; the path is named.
    """
    text = read_text(path)
    with error_prefix(f"cannot read {path}"):
        return parse_json(text)


def read_csv(path: str | os.PathLike[str]) -> list[dict[Any, Any]]:
    """Read a table of CSV as texts by their headings; cells without a heading stand under None, missing ones are None.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is no table; the path is named.
    """
    text = read_text(path)
    with error_prefix(f"cannot read {path}", csv.Error):
        return list(csv.DictReader(io.StringIO(text, newline=""), strict=True))


def csv_bytes(rows: Iterable[Iterable[Any]]) -> bytes:
    """Return a table as the bytes of a CSV file, its headings first."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def json_lines(values: Mapping[str, Any]) -> bytes:
    """Return the bytes of a file of JSON with each entry on a line of its own."""
    lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in values.items())
    return f"{{\n{lines}\n}}\n".encode()


def standard(value: Any) -> Any:
    """Return a value as standard JSON can hold it: NaN and infinity as texts.

    Example:
        >>> standard({"depth_range": (0.5, math.inf)})
        {'depth_range': [0.5, 'inf']}
    """
    if isinstance(value, Mapping):
        return {str(key): standard(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [standard(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def parse_json(text: str | bytes) -> Any:
    """Parse a text of JSON, which may come from anybody.

    Raises:
        ValueError: if it is not JSON; is longer than 8 MiB, since objects take up to 50 times as much; is nested
            deeper than 100 levels; names a value twice; or holds a whole number of more than 300 digits, beyond floats.

    Convention:
        ``NaN`` and ``Infinity`` are numbers: Python writes infinite distances like this.

    Example:
        >>> parse_json("[" * 101 + "]" * 101)
        Traceback (most recent call last):
        ...
        ValueError: its JSON is nested deeper than 100 levels
    """
    if len(text) > LONGEST_JSON:
        raise ValueError(f"its JSON must have at most {LONGEST_JSON} characters, got {len(text)}")
    try:
        value = json.loads(text, object_pairs_hook=_unique, parse_int=_whole)
    except RecursionError:
        raise ValueError(f"its JSON is nested deeper than {DEEPEST_JSON} levels") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"its JSON is not UTF-8: {error.reason} at byte {error.start}") from None
    _check_depth(value)
    return value


def _check_depth(value: Any) -> None:
    """Raise ``ValueError`` for values that are nested so deep that a function that calls itself for them may fail."""
    level, depth = [value], 0
    while level := [part for part in level if isinstance(part, (dict, list))]:
        depth += 1
        if depth > DEEPEST_JSON:
            raise ValueError(f"its JSON is nested deeper than {DEEPEST_JSON} levels")
        level = [inner for part in level for inner in (part.values() if isinstance(part, dict) else part)]


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON; of two values under one name, programs differ in which they take."""
    values = dict(pairs)
    if len(values) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"its JSON names {twice!r:.80} twice")
    return values


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a whole number in its JSON must have at most {MOST_DIGITS} digits, got {len(digits)}")
    return int(digits)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file atomically: under a temporary name in the same folder, then renamed.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the path is a folder.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def error_prefix(words: str, *others: type[Exception]) -> Generator[None]:
    """Put words such as "cannot read FILE" before the message of a ``ValueError`` of a block, unless it has them.

    Args:
        words: before the message, without the colon.
        others: types of errors that become a ``ValueError`` too, as those that a damaged file raises.

    Raises:
        ValueError: with the words.

    Example:
        >>> with error_prefix("cannot read list.json", KeyError):
        ...     {}["rgb"]
        Traceback (most recent call last):
        ...
        ValueError: cannot read list.json: 'rgb'
    """
    try:
        yield
    except (ValueError, *others) as error:
        told = f"{error!s:.500}"
        raise ValueError(told if told.startswith(words) else f"{words}: {told}") from error


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Generator[Path]:
    """Yield a temporary path in the same folder; after success the file written there replaces ``path``.

    Raises:
        FileNotFoundError: if the folder does not exist.
        OSError: if it cannot be written, for example on a full disk; the message names ``path``.
        ValueError: if the path is a folder, or no regular file.

    Convention:
        A symbolic link at ``path`` is replaced by the file; the link's target is not touched.
    """
    path = Path(path)
    check_writable(path)
    temporary = path.with_name(f".{uuid4().hex}.tmp")
    try:
        with _named(path):
            yield temporary
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Check that a file can be written to a path: the folder exists, and no device, pipe or folder has the name.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the path is a folder; or a device or a pipe, which a renamed file would replace, even /dev/null;
            or if its name is too long.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    if _is_folder(path, "write"):
        raise ValueError(f"cannot write {path}: it is a folder")
    if path.exists() and not path.is_file():
        raise ValueError(f"cannot write {path}: it is not a regular file")


def write_folder(path: str | os.PathLike[str], files: Mapping[str, bytes], replace: bool = False) -> None:
    """Write a folder of files atomically: under a temporary name beside it, then renamed.

    Args:
        path: the folder.
        files: contents by name.
        replace: whether an existing folder is replaced as a whole.

    Raises:
        FileExistsError: if the path exists and is not to be replaced, or another process writes it at the same time.
        FileNotFoundError: if the parent folder does not exist.
    """
    path = Path(path).absolute()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    if path.exists() and not (replace and path.is_dir()):
        raise FileExistsError(f"cannot write {path}: it exists")
    new, old = (path.with_name(f".{uuid4().hex}.tmp") for _ in range(2))
    needed = True  # the old folder, until another one stands in its place
    try:
        with _named(path):
            new.mkdir()
            for name, data in files.items():
                (new / name).write_bytes(data)
            faster = f"cannot write {path}: another process has written it meanwhile"
            if path.exists():
                if not replace:
                    raise FileExistsError(faster)
                path.rename(old)
            try:
                new.rename(path)
                needed = False
            except OSError as error:
                needed = error.errno not in {errno.ENOTEMPTY, errno.EEXIST}  # else another writer was faster
                if not needed:
                    raise FileExistsError(faster) from error
                if old.exists():
                    old.rename(path)
                raise
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if not needed:
            shutil.rmtree(old, ignore_errors=True)


@contextmanager
def only_here(folder: str | os.PathLike[str], what: str) -> Generator[None]:
    """Lock an existing folder within a block against other processes and threads that lock it.

    The system releases the lock when the process ends for whatever reason, and no file is left in the folder. On file
    systems without locks nothing is locked.

    Args:
        folder: an existing folder.
        what: the work done in it, in words, for the message.

    Raises:
        ValueError: if the folder is locked already.
    """
    if fcntl is None:
        yield
        return
    place = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"{what} in {folder} already: wait for it to end, or choose another folder") from None
        except OSError:
            pass
        try:
            yield
        finally:
            # Forked processes that outlive the block share the lock, and closing the file would leave it with them.
            with suppress(OSError):
                fcntl.flock(place, fcntl.LOCK_UN)
    finally:
        os.close(place)


@contextmanager
def _named(path: Path) -> Generator[None]:
    """Put the path of the final file into errors about the temporary file, such as "no space left on device"."""
    try:
        yield
    except FileExistsError:  # distinguishes processes that write into one folder
        raise
    except OSError as error:
        kind = FileNotFoundError if isinstance(error, FileNotFoundError) else OSError
        raise kind(f"cannot write {path}: {error.strerror or error}") from error


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove the temporary files of killed processes from a folder into which no process is writing."""
    for path in Path(folder).iterdir():
        if _LEFTOVER.fullmatch(path.name):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
