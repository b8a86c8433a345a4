"""Which share of mutants the tests catch: ``python -m tests.code_mutants --set heart --count 300 --commit HEAD``.

A commit is exported, its quick tests are run once to see which functions each calls, then each mutant meets the tests
that call its function. Results are kept as lines of JSON: a run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import asdict
from math import sqrt
from pathlib import Path

import pytest
from tqdm import tqdm

from tests.code_mutants.calls import CallRecorder, read_calls
from tests.code_mutants.mutants import KINDS, SETS, draw_mutants
from tests.code_mutants.trial import OPTIONS, chosen_tests, enter, try_mutant

ROOT = Path(__file__).resolve().parents[2]
# Imported once, before the forks; the package itself is imported in each of them.
PRELOADED = (
    "torch", "torch._dynamo", "torch._inductor.compile_fx", "torch.fx.experimental.proxy_tensor", "torch.testing",
    "torch.utils.data", "numpy", "scipy.special", "scipy.ndimage", "scipy.optimize", "cv2", "kornia", "imagecodecs",
    "safetensors.torch", "tifffile", "matplotlib.pyplot", "hypothesis", "lightning.pytorch",
)  # fmt: skip


def main() -> int:
    """Draw, try and count."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.code_mutants", description="Faults in the code and the tests."
    )
    parser.add_argument("--commit", default="HEAD", help="whose code and tests are taken (default: HEAD)")
    parser.add_argument("--set", choices=SETS, default="heart", help="the packages that are mutated (default: heart)")
    parser.add_argument("--count", type=int, default=300, help="mutants (default: 300)")
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    parser.add_argument(
        "--folder", type=Path, default=Path("outputs/code_mutants"), help="for the export and what came out"
    )
    args = parser.parse_args()
    folder = args.folder.resolve()
    root, calls_file = export(args.commit, folder), folder / "calls.jsonl"
    for name in PRELOADED:
        try:
            importlib.import_module(name)
        except ImportError:
            print(f"{name} is not installed", file=sys.stderr)
    if not calls_file.exists():
        record_calls(root, calls_file)
    calls = read_calls(calls_file)
    results = folder / f"{args.set}-{args.seed}.jsonl"
    known = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    mutants = draw_mutants(root, args.set, args.count, args.seed)
    for mutant in tqdm(mutants[len(known) :], initial=len(known), total=len(mutants)):
        trial = try_mutant(mutant, chosen_tests(mutant, calls, root), calls, root, folder / "log")
        known.append({**asdict(mutant), "told": mutant.told((root / mutant.path).read_bytes()), **asdict(trial)})
        with results.open("a") as file:
            file.write(json.dumps(known[-1]) + "\n")
    print(table(known))
    return 0


def export(commit: str, folder: Path) -> Path:
    """Write a commit's files into a folder, if they are not there; return where."""
    root = folder / "checkout"
    if not root.exists():
        root.mkdir(parents=True)
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x", "-C", str(root)], input=archive, check=True)
        if (ROOT.parent / "shared").exists():  # that some tests read
            (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
        # By content: a mutant may be as long as its file and made within the same second.
        compile_all = ["compileall", "-q", "--invalidation-mode", "checked-hash", "kornia_tidy"]
        subprocess.run([sys.executable, "-m", *compile_all], cwd=root, check=True)
    return root


def record_calls(root: Path, path: Path) -> None:
    """Run the quick tests, in a fork, and write what each calls: some 20 minutes."""
    process = os.fork()
    if process == 0:
        try:
            for output in (1, 2):  # not a file: a test limits the size of files
                os.dup2(os.open(os.devnull, os.O_WRONLY), output)
            enter(root)
            pytest.main([*OPTIONS, "tests", "kornia_tidy"], plugins=[CallRecorder(root, path)])
        finally:
            os._exit(0)
    os.waitpid(process, 0)


def table(tried: list[dict[str, object]]) -> str:
    """Return the share of mutants that were caught with its standard error, and those that were not."""
    rows = [("all", tried)]
    rows += [(kind, [t for t in tried if t["kind"] == kind]) for kind in KINDS]
    packages = sorted({str(t["path"]).split("/")[1] for t in tried})
    rows += [(name, [t for t in tried if str(t["path"]).split("/")[1] == name]) for name in packages]
    lines = ["| | mutants | caught | share | survived | no test calls it |", "|---|---|---|---|---|---|"]
    for name, some in rows:
        count = Counter(str(t["outcome"]) for t in some)
        total = len(some) - count["no code"]
        share = count["caught"] / max(total, 1)
        share = f"{share:.0%} ± {sqrt(share * (1 - share) / total):.0%}" if total else ""
        lines.append(f"| {name} | {total} | {count['caught']} | {share} | {count['survived']} | {count['uncalled']} |")
    left = [f"- {t['told']}" for t in tried if t["outcome"] in {"survived", "uncalled"}]
    return "\n".join([*lines, "", *left])


if __name__ == "__main__":
    sys.exit(main())
