"""Small whole files of every kind that commands read, and the commands that read them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.torch import save_file

from kornia_tidy import PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.data import dead_leaves, write_depth, write_image
from kornia_tidy.data.pfm import encode_pfm
from kornia_tidy.lab.mask_export import SLMFrames, write_heights, write_slm_frames
from kornia_tidy.modulator import GreyLevels
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import build_head, build_optics
from kornia_tidy.training.settings import TrainingSettings
from tests.base import DATA

SIZE = 48
CAMERA = ("--masks", "1", "--fidelity", "draft")
LARGEST_RAW = 300_000  # bytes


@dataclass(frozen=True)
class Case:
    """A file to be damaged, and what reads it."""

    kind: str
    """Under which it is counted."""
    damage: str
    """Whose ways of damage are its own, see :data:`tests.mutations.damage.BY_KIND`."""
    source: Path
    """The whole file."""
    command: Sequence[str] | Callable[[Path], object]
    """Arguments, in which IN is the damaged file and FOLDER the folder it lies in; or what else reads the file."""
    outputs: Sequence[str] = field(default=())
    """What it may write: files, or folders."""
    companions: Path | None = None
    """A folder of what lies beside the file."""


def make_cases(folder: Path) -> dict[str, list[Case]]:
    """Write whole files into a folder; return what may be done with each, by kind."""
    _write_pictures(folder)
    cases = [*_pictures(folder), *_masks(folder), *_checkpoints(folder), *_folders(folder), *_raws()]
    by_kind: dict[str, list[Case]] = {}
    for case in cases:
        by_kind.setdefault(case.kind, []).append(case)
    return by_kind


def _write_pictures(folder: Path) -> None:
    image, depth = dead_leaves(SIZE, SIZE, num_leaves=60, seed=0)
    rows = image.permute(1, 2, 0).numpy()
    for bits, name in ((8, "image.png"), (16, "image16.png"), (8, "image.tif"), (16, "image16.tif"), (8, "image.jpg")):
        write_image(folder / name, image, bits)
    write_image(folder / "grey.png", image.mean(0, keepdim=True))
    cv2.imwrite(
        str(folder / "progressive.jpg"), np.rint(255 * rows).astype(np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    )
    cv2.imwrite(str(folder / "float.tif"), rows)
    np.save(folder / "image.npy", rows)
    np.save(folder / "image8.npy", np.rint(255 * rows).astype(np.uint8))
    (folder / "image.pfm").write_bytes(encode_pfm(rows))
    for suffix in ("png", "pfm", "npy"):
        write_depth(folder / f"depth.{suffix}", depth.clamp(max=60), 0.001 if suffix == "png" else 1.0, saturate=True)
    cv2.imwrite(str(folder / "depth.tif"), depth[0].numpy())
    head = f"P7\nWIDTH {SIZE}\nHEIGHT {SIZE}\nDEPTH 3\nMAXVAL 1023\nTUPLTYPE RGB\nENDHDR\n".encode()
    (folder / "image.pam").write_bytes(head + np.rint(1023 * rows).astype(">u2").tobytes())
    np.savez_compressed(folder / "depth.npz", depth[0].numpy())
    with suppress(ImportError):  # an extra
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Z": depth[0].numpy()}).write(str(folder / "depth.exr"))


def _pictures(folder: Path) -> list[Case]:
    """Each file as the picture or the depth of a scene with an intact other half."""
    kinds = {".tif": "tiff", ".jpg": "jpeg"}
    cases = []
    for path in sorted(folder.iterdir()):
        kind, out = kinds.get(path.suffix, path.suffix[1:]), ("-o", "out.png", *CAMERA)
        if path.stem == "depth":
            scale = ("--depth-scale", "0.001") if kind == "png" else ()
            argv = ("simulate", str(folder / "image.png"), "--depth", "IN", "--holes", "fill", *scale, *out)
        else:
            argv = ("simulate", "IN", "--depth", str(folder / "depth.pfm"), *out)
        cases.append(Case(kind, kind, path, argv, ("out.png",)))
    return cases


def _masks(folder: Path) -> list[Case]:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(0))
    write_heights(folder / "heights.npy", masks.heights().detach().double())
    write_heights(folder / "heights.safetensors", masks.heights().detach().double())
    optics = TiDyOptics(masks, fidelity="draft")
    optics.psf_bank().save(folder / "bank.safetensors")
    save_file(optics.state_dict(), folder / "camera.safetensors")
    (folder / "lut.txt").write_text(" ".join(f"{level / 40.6:.6f}" for level in range(256)))
    write_slm_frames(folder / "frames", SLMFrames.of(20 * masks.heights().detach(), GreyLevels(8)))
    read_frames = ("masks", "import", "FOLDER", "-o", "out.npy")
    sidecar, turns, frame = (folder / "frames" / name for name in ("frames.json", "turns.npy", "frame_000.png"))
    files = [("npy", folder / "heights.npy")]
    files += [("safetensors", folder / f"{name}.safetensors") for name in ("heights", "camera")]
    return [
        *(Case(kind, kind, path, ("masks", "show", "IN")) for kind, path in files),
        *(Case(kind, kind, path, ("masks", "export", "IN", "-o", "out.npy"), ("out.npy",)) for kind, path in files),
        Case("safetensors", "safetensors", folder / "bank.safetensors", PSFBank.load),
        Case(
            "response",
            "raw",
            folder / "lut.txt",
            ("masks", "export", str(folder / "heights.npy"), "-o", "slm", "--response", "IN"),
            ("slm",),
        ),
        *(Case("sidecar", "json", sidecar, read_frames, ("out.npy",), folder / "frames") for _ in range(4)),
        Case("sidecar", "npy", turns, read_frames, ("out.npy",), folder / "frames"),
        Case("sidecar", "png", frame, read_frames, ("out.npy",), folder / "frames"),
    ]


def _checkpoints(folder: Path) -> list[Case]:
    """Untrained systems in the format of trained ones: one with the capture as input, one with refocused images."""
    plain = TrainingSettings(
        task="joint", masks=2, head="plain", width=4, size=32, scenes=2, validation_scenes=1, window=9,
        fidelity="draft",
    )  # fmt: skip
    for name, settings in (("plain", plain), ("refocused", plain.replace(task="edof", refocus=2, residual=True))):
        torch.manual_seed(0)
        optics, head = build_optics(settings), build_head(settings)
        weights = {f"{part}.{key}": value for part, module in (("optics", optics), ("head", head))
                   for key, value in module.state_dict().items()}  # fmt: skip
        state = {"settings": settings.as_dict(), "state_dict": weights, "global_step": 3}
        write_state(folder / f"{name}.safetensors", state)
    given = ("--data", "dead-leaves", "--size", "32", "--scenes", "1", "-o", "out")
    return [
        Case("checkpoint", "checkpoint", folder / f"{name}.safetensors", (command, *argv, *given), ("out",))
        for name in ("plain", "refocused")
        for command, argv in (
            ("render", ("--split", "test", "--checkpoint", "IN")),
            ("evaluate", ("IN", "--pictures", "1")),
        )
    ]


def _folders(folder: Path) -> list[Case]:
    root = folder / "rgbd"
    root.mkdir()
    for name in ("lamp", "chair"):
        shutil.copy(folder / "image.png", root / f"{name}.png")
        shutil.copy(folder / "depth.png", root / f"{name}_depth.png")
    about = root / "rgbd.json"
    about.write_text('{"image": "*.png", "depth": "*_depth.png", "scale": 0.001, "invalid": [65535], "kind": "depth"}')
    argv = (
        "render",
        "--data",
        "rgbd-folder",
        "--root",
        "FOLDER",
        "--split",
        "all",
        "--size",
        "32",
        "-o",
        "out",
        *CAMERA,
    )
    return [Case("rgbd.json", "json", about, argv, ("out",), root)]


def _raws() -> list[Case]:
    """Those of the data, where there are any."""
    paths = [p for part in ("raw", "raw_synthetic") for p in sorted((DATA / part).rglob("*")) if p.is_file()]
    # Headerless dumps and files of other kinds are refused by their first bytes, whatever comes later.
    paths = [
        p
        for p in paths
        if 1000 < p.stat().st_size < LARGEST_RAW and p.parent.name[:6] not in {"mushfi", "cruxop", "drewno"}
    ]
    return [
        Case("raw", "raw", path, argv, outputs)
        for path in paths
        for argv, outputs in (
            (("raw", "info", "IN"), ()),
            (("raw", "develop", "IN", "-o", "out", "--no-preview", "--demosaic", "half"), ("out",)),
        )
    ]
