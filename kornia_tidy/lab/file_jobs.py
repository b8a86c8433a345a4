"""Work on several files, with a progress bar, its summary, and where the results go."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from kornia_tidy.files import output_folder


class Row(NamedTuple):
    """A line of the summary."""

    file: str
    result: str
    size: str = ""
    seconds: float | None = None
    notes: tuple[str, ...] = ()
    """What there is to tell of the file; not in the table."""


def for_each_file(paths: Sequence[str], work: Callable[[str], None]) -> None:
    """Apply an action to every file, and go on after errors.

    Args:
        paths: of the files.
        work: the action.

    Raises:
        OSError, ValueError: the error of a single file; for several files the number that failed, after their errors
            have been printed.
    """
    failed = 0
    for path in paths:
        try:
            work(path)
        except (OSError, ValueError) as error:
            if len(paths) == 1:
                raise
            failed += 1
            _print_error(error)
    if failed:
        raise ValueError(f"{failed} of {len(paths)} files failed")


def work_on_all(title: str, paths: Sequence[str], work: Callable[[str, Callable[[int, int], None]], Row]) -> list[Row]:
    """Process files one after another with a progress bar, and go on after errors.

    Args:
        title: of the progress bar.
        paths: of the files.
        work: processes a file and returns its row. It is also given a function to call with the number of tiles that
            are done and of all.

    Returns:
        A row for each file; of one that failed the sentence of its error, which is also printed.

    Example:
        >>> [row.result for row in work_on_all("measure", ["a", "b"], lambda path, progress: Row(path, "done"))]
        ['done', 'done']
    """
    rows = []
    form = "{l_bar}{bar}| {n:.2f}/{total} [{elapsed}<{remaining}]"
    with tqdm(total=len(paths), desc=title, file=sys.stderr, leave=False, bar_format=form) as bar:
        for number, path in enumerate(paths):
            try:
                rows.append(work(path, lambda done, tiles: bar.update(number + done / tiles - bar.n)))  # noqa: B023
            except Exception as error:
                rows.append(Row(path, _print_error(error)))
            bar.update(number + 1 - bar.n)
    return rows


def output_paths(files: Sequence[str], folder: Path, suffixes: Sequence[str]) -> dict[str, list[Path]]:
    """Return the output paths of each file.

    Args:
        files: inputs; one that is named twice counts once, by whichever path.
        folder: of the outputs.
        suffixes: replacements of a file's suffix, one for each output.

    Raises:
        ValueError: if the folder is a file, two files would become the same picture, or a picture would replace one of
            the files.

    Example:
        >>> output_paths(["shots/a.dng", "shots/../shots/a.dng"], Path("sharp"), [".png", ".json"])
        {'shots/a.dng': [PosixPath('sharp/a.png'), PosixPath('sharp/a.json')]}
    """
    output_folder(folder)
    outputs: dict[str, list[Path]] = {}
    owners: dict[str, str] = {}
    first = {Path(path).resolve(): path for path in reversed(files)}
    for path in dict.fromkeys(first[Path(path).resolve()] for path in files):
        stem = Path(path).stem
        if stem in owners:
            raise ValueError(f"{owners[stem]} and {path} would both become {folder / stem}{suffixes[0]}")
        owners[stem] = path
        outputs[path] = [folder / f"{stem}{suffix}" for suffix in suffixes]
    taken = {Path(path).resolve() for path in files}
    for output in (output for each in outputs.values() for output in each):
        if output.resolve() in taken:
            raise ValueError(f"cannot write {output}: it is an input")
    return outputs


def table(rows: list[Row]) -> list[str]:
    """Return the summary with one line per file.

    Example:
        >>> for line in table([Row("a.dng", "done", "60 x 40", 1.25), Row("bb.dng", "cannot read bb.dng: empty")]):
        ...     print(line)
        file    size     seconds  result
        a.dng   60 x 40     1.25  done
        bb.dng                    cannot read bb.dng: empty
    """
    files, sizes = (max(len(name), *(len(row[i]) for row in rows)) for i, name in ((0, "file"), (2, "size")))
    lines = [f"{'file':<{files}}  {'size':<{sizes}}  seconds  result"]
    for row in rows:
        seconds = "" if row.seconds is None else f"{row.seconds:.2f}"
        lines.append(f"{row.file:<{files}}  {row.size:<{sizes}}  {seconds:>7}  {row.result}")
    return lines


def _print_error(error: Exception) -> str:
    """Print an error as one sentence, and return the sentence."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    tqdm.write(f"kornia-tidy: error: {sentence}", file=sys.stderr)
    sys.stderr.flush()
    return sentence
