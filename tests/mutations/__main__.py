"""Thousands of damaged files through the command's own entry: `python -m tests.mutations --count 5000 --seed 0`.

Each is read by a process of its own, forked from this one, which has imported everything and computed nothing. It must
end in time with exit status 0, or 2 and one sentence; no traceback, no signal, nothing half written. What fails is kept
with the arguments that show it. A raw file takes an interpreter of its own each, so that there are fewer of them.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from tests.mutations.damage import damaged
from tests.mutations.forked import Outcome, clear, prepare, run, shown
from tests.mutations.pristine import Case, make_cases

SHARES = {
    "npy": 16, "png": 16, "tiff": 12, "pfm": 8, "pam": 4, "npz": 4, "exr": 4, "jpeg": 12,
    "safetensors": 10, "checkpoint": 10, "rgbd.json": 5, "sidecar": 5, "response": 4, "raw": 6,
}  # fmt: skip
NAMES = ("accepted", "refused", "guard", "failed")


def main() -> int:
    """Run, and return 0 if all behaved."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description="Damaged files through the command.")
    parser.add_argument("--count", type=int, default=5000, help="files (default: 5000)")
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    parser.add_argument("--kind", choices=tuple(SHARES), help="of this kind only")
    parser.add_argument("--keep", type=Path, default=Path("outputs/mutations"), help="where failures are kept")
    parser.add_argument("--reasons", action="store_true", help="print the sentences too, without their numbers")
    args = parser.parse_args()
    torch.set_num_threads(1)  # threads do not live on in a fork
    begin = time.perf_counter()
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in ([args.kind] if args.kind else SHARES)}
    reasons: Counter[str] = Counter()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "whole").mkdir()
        cases = make_cases(folder / "whole")
        for kind in [kind for kind in counts if kind not in cases]:
            print(f"{kind}: no such files on this machine, left out")
            del counts[kind]
        numbers = _numbers(args.count, list(counts))
        for kind, count in counts.items():
            for number in range(numbers[kind]):
                case, how, data = _damaged(cases[kind], kind, args.seed, number)
                outcome = _run(case, data, folder / "case")
                count[outcome.name] += 1
                slowest = max(slowest, outcome.seconds)
                reasons[_reason(outcome)] += 1
                if outcome.faults:
                    kept = args.keep / f"{kind}-{args.seed}-{number}"
                    _keep(kept, case, data, outcome)
                    print(f"{kept}: {how} of {case.source.name}: {'; '.join(outcome.faults)}", flush=True)
                clear(folder / "case")
    _tell(counts)
    for reason, number in reasons.most_common() if args.reasons else ():
        print(f"{number:6d}  {reason}")
    print(f"{time.perf_counter() - begin:.0f} s, the slowest {slowest:.1f} s")
    return int(any(count["guard"] + count["failed"] for count in counts.values()))


def _numbers(count: int, kinds: list[str]) -> dict[str, int]:
    """How many files of each kind, at least one."""
    whole = sum(SHARES[kind] for kind in kinds)
    ends = np.cumsum([0, *(SHARES[kind] for kind in kinds)]) * count / whole
    return {kind: max(1, round(b) - round(a)) for kind, a, b in zip(kinds, ends[:-1], ends[1:], strict=True)}


def _damaged(cases: list[Case], kind: str, seed: int, number: int) -> tuple[Case, str, bytes]:
    generator = np.random.default_rng([seed, number, *kind.encode()])
    case = cases[int(generator.integers(len(cases)))]
    return case, *damaged(case.source.read_bytes(), case.damage, generator)


def _run(case: Case, data: bytes, folder: Path) -> Outcome:
    return run(case, prepare(case, data, folder), folder)


def _reason(outcome: Outcome) -> str:
    last = outcome.told.strip().splitlines()[-1:] or ["nothing said"]
    short = re.sub(r"/\S+/", "", last[0])
    return re.sub(r"-?\d[\d.e+]*", "N", short)[:150]


def _keep(folder: Path, case: Case, data: bytes, outcome: Outcome) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / case.source.name).write_bytes(data)
    (folder / "told.txt").write_text(
        f"{shown(case.command)}\nstatus {outcome.status}, {outcome.seconds:.1f} s\n"
        f"{'; '.join(outcome.faults)}\n\n{outcome.told}"
    )


def _tell(counts: dict[str, Counter[str]]) -> None:
    print(f"{'kind':<12}{'files':>8}" + "".join(f"{name:>10}" for name in NAMES))
    for kind, count in [*counts.items(), ("all", sum(counts.values(), Counter()))]:
        print(f"{kind:<12}{sum(count.values()):>8}" + "".join(f"{count[name]:>10}" for name in NAMES))


if __name__ == "__main__":
    sys.exit(main())
