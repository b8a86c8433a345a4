"""Report of the compiled kernels: the compiler, where each kernel came from, and the cache."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import product

from kornia_tidy.kernels.build import KERNELS, REALS, build, cache_folder, vector_bytes
from kornia_tidy.kernels.compiler import find_compiler

SOURCES = sorted(KERNELS.glob("*.c"))


def kernels_in_words() -> Iterator[tuple[str, str]]:
    """Yield the compiler, the kernels and their cache as topics and texts; kernels that are missing are compiled.

    Example:
        >>> next(kernels_in_words())[0]
        'compiler'
    """
    yield "compiler", _compiler()
    for source, dtype in product(SOURCES, REALS):
        name = f"{source.name}, {str(dtype).removeprefix('torch.')}"
        built = build(source, dtype)
        if built.path is None or built.library is None:
            yield "kernel", f"{name}: not there: {built.remark}"
        else:
            threads = "" if built.threads else ", in one thread"
            remark = f": {built.remark}" if built.remark else ""
            width = f"vectors of {vector_bytes(built.library)} bytes"
            yield "kernel", f"{name}: {built.origin}{threads}, {width}, {built.path.name}{remark}"
    yield "cache", _cache()


def _compiler() -> str:
    try:
        compiler = find_compiler()
    except RuntimeError as error:
        return str(error)
    return f"{' '.join((*compiler.program, *compiler.options))}: {compiler.version}"


def _cache() -> str:
    try:
        folder = cache_folder()
    except OSError as error:
        return f"none: {error}"
    sizes = []
    for path in folder.iterdir():
        with suppress(OSError):  # another process may remove it at any moment
            if path.is_file():
                sizes.append(path.stat().st_size)
    return f"{folder}, {len(sizes)} files, {sum(sizes) >> 10} KiB"
