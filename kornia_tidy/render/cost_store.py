"""The cost profile in use: which one a process computes with, and the file in the user's cache that keeps it.

Within a process a profile is fixed once it was asked for: the same input then goes to the same backend, and comes out
bit for bit the same. Another machine, or the same one after ``kornia-tidy tune``, may take another backend, whose image
differs in the last digits.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from kornia_tidy.kernels.build import (
    KERNELS,
    NotBuiltError,
    cache_folder,
    find_compiler,
    is_ours,
    processor_features,
    target_vector_bytes,
)
from kornia_tidy.render.cost_profile import EPYC, RATES, XEON, CostProfile
from kornia_tidy.render.repeatable import of_thread
from kornia_tidy.runtime.threads import SharedLock

TUNE = "KORNIA_TIDY_TUNE"  # in the environment, "off": nothing is measured, nothing is read from the cache
KINDS = {
    "gather": ("direct", "tiled", "overlap", "dense"),
    "occlusion": ("occlusion_direct", "occlusion_tiled", "occlusion_dense"),
}  # rates that are measured together
LARGEST_FILE = 1 << 16  # bytes

profile_lock = SharedLock()  # held while a profile is chosen
_settled: dict[int, StoredProfile] = {}  # by threads
_measured: dict[tuple[int, str], CostProfile] = {}  # by threads and kind of compositing


@dataclass(frozen=True)
class StoredProfile:
    """A profile, and the kinds of compositing that it was measured for.

    Args:
        profile: the prices.
        measured: kinds of compositing, of :data:`KINDS`, whose rates were measured on this machine.
    """

    profile: CostProfile
    measured: tuple[str, ...] = ()


def shipped_profile() -> CostProfile:
    """Return the profile of the kind of processor that is nearest to this one."""
    return XEON if b"GenuineIntel" in processor_features() or b"Intel" in processor_features() else EPYC


def is_tuning_off() -> bool:
    """Return whether the environment turns off measurements and their use."""
    return os.environ.get(TUNE, "").strip().lower() in ("off", "0", "no")


def settled() -> StoredProfile:
    """Return the profile that this process starts from, for torch's threads: from the cache, or as shipped.

    Where rendering must be repeatable it is the shipped one, and nothing is measured.
    """
    if of_thread.repeatable:
        return StoredProfile(shipped_profile(), tuple(KINDS))
    threads = torch.get_num_threads()
    if threads not in _settled:
        with profile_lock:
            if threads not in _settled:
                _settled[threads] = read_profile(threads) or StoredProfile(shipped_profile())
    return _settled[threads]


def settled_profile() -> CostProfile:
    """Return the profile of :func:`settled`."""
    return settled().profile


def measured_profile(kind: str) -> CostProfile | None:
    """Return the profile that first use has measured in this process for a kind of compositing, None if it has not."""
    return _measured.get((torch.get_num_threads(), kind))


def settle_measured(kind: str, profile: CostProfile, *, keep: bool = True) -> None:
    """Fix the profile of a kind of compositing for the rest of the process.

    Args:
        kind: of compositing, a key of :data:`KINDS`.
        profile: measured.
        keep: for other processes too. Where the cache cannot be written to, it serves this process alone.
    """
    threads = torch.get_num_threads()
    _measured[threads, kind] = profile
    if not keep:
        return
    with suppress(OSError):
        kept = read_profile(threads) or settled()
        both = {name: getattr(profile, name).__dict__ for name in KINDS[kind]}
        document = {**kept.profile.as_json(), **both, "name": profile.name}
        write_profile(threads, StoredProfile(CostProfile.from_json(document), tuple({*kept.measured, kind})))


def forget_in_process() -> None:
    """Let the profile be chosen anew, as in a new process."""
    with profile_lock:
        _settled.clear()
        _measured.clear()


# ---------------------------------------------------------------------- the cache


def profile_path(threads: int) -> Path:
    """Return the file of a number of threads, named after all that times depend on.

    That is the processor, the threads, torch, the C compiler, the width of its vectors, the C sources, and the terms of
    the profile.

    Raises:
        OSError: if there is no folder that can be used.
    """
    try:
        compiler = f"{find_compiler().version}, vectors of {target_vector_bytes(find_compiler())} bytes"
    except NotBuiltError:
        compiler = "no compiler"
    terms = [f"{name}: {', '.join(kind.__dataclass_fields__)}" for name, kind in RATES.items()]
    words = [str(threads), torch.__version__, compiler, *terms]
    sources = [path.read_bytes() for path in sorted(KERNELS.glob("*.[ch]"))]
    parts = [processor_features(), *(word.encode() for word in words), *sources]
    digest = hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]
    return cache_folder() / f"costs-{digest}.json"


def read_profile(threads: int) -> StoredProfile | None:
    """Return the profile that is kept for a number of threads, None if there is none that can be trusted.

    The file must be the user's own, and nobody else may write to it. It is read as numbers.
    """
    if is_tuning_off():
        return None
    try:
        path = profile_path(threads)
        status = path.lstat()
        if not (stat.S_ISREG(status.st_mode) and is_ours(status) and status.st_size <= LARGEST_FILE):
            return None
        document = json.loads(path.read_text())
        return _stored(document)
    except (OSError, ValueError, RecursionError):
        return None


def _stored(document: Any) -> StoredProfile:
    if not isinstance(document, dict) or not isinstance(document.get("measured"), list):
        raise ValueError("a kept cost profile has a profile and what was measured of it")
    measured = tuple(kind for kind in KINDS if kind in document["measured"])
    return StoredProfile(CostProfile.from_json(document.get("profile")), measured)


def write_profile(threads: int, stored: StoredProfile) -> Path:
    """Keep a profile for a number of threads, whole or not at all, and return its file.

    Raises:
        OSError: if it cannot be kept.
    """
    path = profile_path(threads)
    document = {"profile": stored.profile.as_json(), "measured": sorted(stored.measured)}
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        new = Path(folder) / path.name
        new.write_text(json.dumps(document, indent=1))
        new.chmod(0o600)
        new.replace(path)
    return path


def forget_profile(threads: int) -> Path | None:
    """Remove the profile that is kept for a number of threads, and return its file, None if there was none.

    Raises:
        OSError: if it cannot be removed.
    """
    path = profile_path(threads)
    if not path.is_file():
        return None
    path.unlink()
    return path
