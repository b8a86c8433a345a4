"""Measure scores of optical systems and restorations on the same scenes, and write tables, CSV and a picture.

- ``python -m tests.benchmarks.results`` measures all systems, restorations and noises: some hours on one core. A value
  is kept in FOLDER/results.sqlite as soon as it is measured; the same command goes on where it was interrupted. Two of
  them may share the work, with different ``--systems``.
- ``--quick`` takes two small scenes, two systems and one noise: seconds.
- ``--checkpoint outputs/run/best.safetensors`` adds a trained system.
- ``--physical`` takes shot and read noise at equal exposure time alone. A designed camera against the best lens without
  masks, each with its own network, where DESIGNS are folders of ``kornia-tidy design`` for the four amounts of light:
  ``--physical --checkpoint outputs/designed/best.safetensors outputs/flat/best.safetensors --restorations network
  --designs DESIGNS``
- ``--report`` measures nothing and writes results.md, results.csv and results.png of what is there. ``--page
  docs/record/results.md`` writes the page and its picture there, too.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import torch
from tqdm import tqdm

from kornia_tidy.design.tradeoff.conditions import device_name
from kornia_tidy.files import write_bytes
from tests.benchmarks.results.captures import FIXED, PHYSICAL, sensor_of
from tests.benchmarks.results.figure import draw_results
from tests.benchmarks.results.measure import Measurement
from tests.benchmarks.results.report import PICTURE, page, scores_csv
from tests.benchmarks.results.scenes import SceneSet, dead_leaves, real_scenes
from tests.benchmarks.results.store import Provenance, Store
from tests.benchmarks.results.systems import System, available, from_checkpoint
from tests.benchmarks.results.table import Results
from tests.benchmarks.results.verdicts import REAL, in_words, recommendations, verdicts

SETS = {REAL: real_scenes, "leaves": dead_leaves}
QUICK_SYSTEMS, QUICK_SCENES, QUICK_SIZE = ("edof-5", "flat f/50"), 2, 96
DOTS_PER_INCH = 130


def main(arguments: list[str] | None = None) -> None:
    """Run the command."""
    args = _parser().parse_args(arguments)
    folder: Path = args.folder or Path("outputs/results-quick" if args.quick else "outputs/results")
    folder.mkdir(parents=True, exist_ok=True)
    systems = _systems(args)
    for noise in args.noises:
        sensor_of(noise, 17.6)  # raises for an unknown noise, before any work
    recommended = recommendations(args.designs)
    sets = _sets(args)
    with Store(folder / "results.sqlite", _provenance()) as store:
        if not args.report:
            _measure(store, sets, systems, args)
        results, cells = Results(store.cells(), store.systems(), sets), store.cells()
    if not results.rows:
        raise SystemExit(f"{folder} holds no complete results yet: run without --report")
    pages = [folder / "results.md", *([] if args.page is None else [args.page])]
    picture = BytesIO()
    draw_results(results, sets[0].name).savefig(picture, dpi=DOTS_PER_INCH)
    for path in pages:
        (path.parent / PICTURE).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, page(results, cells, recommended).encode())
        write_bytes(path.parent / PICTURE, picture.getvalue())
    write_bytes(folder / "results.csv", scores_csv(results).encode())
    print("\n".join(in_words(verdicts(results, recommended))))
    print(f"wrote {', '.join(map(str, pages))} and {folder / 'results.csv'}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.results",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", nargs="?", type=Path, help="of the results (default: outputs/results)")
    parser.add_argument("--quick", action="store_true", help="two scenes, two systems, one noise")
    parser.add_argument("--scenes", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--systems", nargs="+", metavar="NAME", help=f"default: all of {', '.join(available())}")
    parser.add_argument("--checkpoint", nargs="+", type=Path, default=[], help="trained systems to add")
    parser.add_argument(
        "--noises",
        nargs="+",
        metavar="NOISE",
        default=[*FIXED, *PHYSICAL],
        help="standard deviations, 0.002, or electrons of white at f/17.6, 57000e (default: %(default)s)",
    )
    parser.add_argument(
        "--physical",
        dest="noises",
        action="store_const",
        const=[*PHYSICAL],
        help=f"the same as --noises {' '.join(PHYSICAL)}",
    )
    parser.add_argument(
        "--designs",
        nargs="+",
        type=Path,
        default=[],
        metavar="FOLDER",
        help="of kornia-tidy design: does what they recommend lose anywhere by more than two standard errors?",
    )
    parser.add_argument("--restorations", nargs="+", metavar="NAME", help="default: all that a system has")
    parser.add_argument("--report", action="store_true", help="measure nothing")
    parser.add_argument("--page", type=Path, help="another place for the page, such as docs/record/results.md")
    return parser


def _systems(args: argparse.Namespace) -> list[Callable[[], System]]:
    """Return functions that make the systems asked for."""
    known = available()
    names = args.systems or (QUICK_SYSTEMS if args.quick else () if args.checkpoint else tuple(known))
    if unknown := [name for name in names if name not in known]:
        raise SystemExit(f"there is no system {unknown[0]!r}: choose among {', '.join(known)}")
    return [*(known[name] for name in names), *((lambda path=path: from_checkpoint(path)) for path in args.checkpoint)]


def _sets(args: argparse.Namespace) -> list[SceneSet]:
    if args.quick:
        args.noises = args.noises[:1]
        return [dead_leaves(QUICK_SCENES, QUICK_SIZE)]
    found = [SETS[name]() for name in args.scenes]
    for each in found:
        if not each.names:
            print(f"the {each.name} scenes are left out: ../shared/data is not on this machine", file=sys.stderr)
    return [each for each in found if each.names]


def _measure(store: Store, sets: list[SceneSet], systems: list[Callable[[], System]], args: argparse.Namespace) -> None:
    with tqdm(total=len(sets) * len(systems) * len(args.noises), desc="results", file=sys.stderr) as progress:
        for scenes in sets:
            measurement = Measurement(store, scenes, args.restorations)
            measurement.measure_depth_without_camera()
            for make in systems:
                measurement.measure(make(), args.noises, progress)


def _provenance() -> Provenance:
    here = Path(__file__).parent
    done = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False, cwd=here
    )
    processor, cpuinfo = device_name(torch.device("cpu")), Path("/proc/cpuinfo")
    virtual = ", virtual machine" if cpuinfo.is_file() and "hypervisor" in cpuinfo.read_text() else ""
    threads = torch.get_num_threads()
    words = f"{os.cpu_count()} cores of {processor}{virtual}, {threads} thread{'s' * (threads > 1)}"
    today = datetime.now(UTC).date().isoformat()
    return Provenance(today, done.stdout.strip() or "unknown", f"{words}, PyTorch {torch.__version__}")


if __name__ == "__main__":
    main()
