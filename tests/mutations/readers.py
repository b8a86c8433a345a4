"""Every function that reads files, with small whole files for it; `tests.mutations.reading` damages them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch
from PIL import Image

from kornia_tidy import PSFBank, TiDyOptics
from kornia_tidy.data import DeadLeaves, NYUDepthV2, TUMSequence, described_folder, read_depth, read_image
from kornia_tidy.data.calibration_files import read_calibration
from kornia_tidy.data.picture_header import check_header
from kornia_tidy.figures.learning_curve import draw_learning_curve
from kornia_tidy.lab.calibration.noise import PhotonTransfer
from kornia_tidy.lab.calibration.noise.photon_transfer import TransferLine, write_json
from kornia_tidy.lab.calibration.noise.photon_transfer import read_json as read_noise
from kornia_tidy.lab.calibration.noise.transfer_curve import CurvePoint
from kornia_tidy.lab.calibration.psf import MeasuredPSFs, PointReport
from kornia_tidy.lab.mask_export import read_heights, read_response, read_slm_frames
from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.lab.raw.dng_sensor import dng_sensor, ignored_opcodes, missing_bytes
from kornia_tidy.lab.raw.tags import camera_tags, tiff_directories
from kornia_tidy.optics import Lens
from kornia_tidy.reconstruction import load_midas_small
from kornia_tidy.reconstruction.hub import from_pretrained, save_pretrained
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import read_state
from kornia_tidy.reconstruction.trained import load_camera, load_trained
from kornia_tidy.training.callbacks import drop_rows_after
from kornia_tidy.training.coded_datasets import CodedCaptures, Layout, decode_sample, render_scenes
from kornia_tidy.training.coded_datasets.index import encode_index
from kornia_tidy.training.noise_free import NoiseFreeCaptures
from kornia_tidy.training.record import training_record
from tests.data.published import write_nyu
from tests.data.tiff_walk import cases as combinations
from tests.data.tiff_walk import make as make_tiff
from tests.lab.raw.dng import dng
from tests.mutations.pristine import Case, write_files
from tests.optics.lens.written_files import WRITERS, doublet

SHARES = {
    "checkpoint": 0.1,
    "nyu": 0.1,
    "raw": 0.005,
    "weights": 0.02,
    "figure": 0.02,
    "index": 2,
    "header": 3,
    "tiff": 4,
}
"""Of slow readers fewer cases are tried than of the others, which count 1."""

TIFFS = 150
"""Combinations of properties that are damaged."""

KINDS = {"png", "tiff", "jpeg", "pfm", "npy", "npz", "ppm", "pam", "bmp", "webp", "hdf5", "exr"}
"""Of pictures and depth."""


def make_readers(folder: Path) -> dict[str, list[Case]]:
    """Write whole files into an empty folder; return the readers of each kind of file."""
    write_files(folder)
    cases = [*_pictures(folder), *_tiffs(folder / "tiffs"), *_numbers(folder), *_systems(folder),
             *_calibrations(folder / "calibrations"), *_folders(folder), *_runs(folder / "run"),
             *_raw_files(folder)]  # fmt: skip
    by_kind: dict[str, list[Case]] = {}
    for case in cases:
        by_kind.setdefault(case.kind, []).append(case)
    return by_kind


def _pictures(folder: Path) -> list[Case]:
    """Pictures and depth maps in every format."""
    rows = np.rint(255 * np.load(folder / "image.npy")).astype(np.uint8)
    for suffix in ("bmp", "webp", "ppm"):
        cv2.imwrite(str(folder / f"image.{suffix}"), rows)
    cv2.imwrite(str(folder / "image.pgm"), rows[..., 0])
    cv2.imwrite(str(folder / "plain.ppm"), rows, [cv2.IMWRITE_PXM_BINARY, 0])
    height, width = rows.shape[:2]
    (folder / "image.pbm").write_bytes(f"P1 {width} {height}\n".encode() + (rows[..., 0] // 128 + 48).tobytes())
    np.savez(folder / "image.npz", image=rows)
    depth = np.load(folder / "depth.npy")
    (folder / "depth.pgm").write_bytes(f"P2\n{width} {height}\n999\n".encode() + b" ".join(
        b"%d" % value for value in np.minimum(99 * depth, 999).astype(int).ravel().tolist()))  # fmt: skip
    _write_exr(folder, depth)
    with h5py.File(folder / "depth.hdf5", "w") as file:
        file.create_dataset("dataset", data=depth, chunks=(16, 16), compression="gzip")
    with h5py.File(folder / "plain.hdf5", "w") as file:
        file.create_dataset("dataset", data=depth)
    cases = []
    for path in sorted(folder.iterdir()):
        kind = {".tif": "tiff", ".jpg": "jpeg", ".pgm": "ppm", ".pbm": "ppm"}.get(path.suffix, path.suffix[1:])
        if kind not in KINDS or path.stem == "heights":
            continue
        damage = {"ppm": "pfm", "bmp": "raw", "webp": "raw"}.get(kind, kind)
        depth_file = path.stem.startswith("depth") or path.suffix == ".hdf5"
        cases.append(Case(kind, damage, path, read_depth if depth_file else read_image))
        if kind in {"png", "jpeg", "bmp", "webp"}:
            cases.append(Case("header", damage, path, lambda path: check_header(path.read_bytes())))
    return cases


def _tiffs(folder: Path) -> list[Case]:
    """TIFF files with many combinations of properties, as a picture and as depth."""
    folder.mkdir()
    rows = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    cases = []
    for name, picture in (("jpeg", rows), ("group3", rows[..., 0] > 99), ("group4", rows[..., 0] > 99)):
        path = folder / f"{name}.tif"
        Image.fromarray(picture).save(path, compression=name)
        cases.append(Case("tiff", "tiff", path, read_image))
    for number, made in enumerate(combinations(TIFFS, 0)):
        path = folder / f"{number:03d}.tif"
        path.write_bytes(make_tiff(made, np.random.default_rng(number))[0])
        for depth, read in ((False, read_image), (True, read_depth)):
            if not made.refusals(depth):
                cases.append(Case("tiff", "tiff", path, read))
    return cases


def _write_exr(folder: Path, depth: np.ndarray) -> None:
    """Write depth in each compression and layout of OpenEXR, if its package is installed."""
    try:
        import OpenEXR
    except ImportError:
        return
    half, values = depth.astype(np.float16), {"Z": depth}
    for number, name in enumerate(name for name in dir(OpenEXR) if name.endswith("_COMPRESSION") and "J2K" not in name):
        header = {"compression": getattr(OpenEXR, name), "type": OpenEXR.scanlineimage}
        if number % 2:
            header |= {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
        channels = {"R": half, "G": half, "B": half, **values} if number % 3 else values
        OpenEXR.File(header, channels).write(str(folder / f"depth_{name}.exr"))
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage, "name": name}, {"Y": depth}, name) for name in ("id", "depth")
    ]
    OpenEXR.File(parts).write(str(folder / "depth_parts.exr"))


def _numbers(folder: Path) -> list[Case]:
    """Masks, PSFs and frames."""
    bank = PSFBank.load(folder / "bank.safetensors")
    distances = torch.linspace(2, 0.4, len(bank.defocus))
    reports = (PointReport(0.5, 1.0, 2.0, 1.0, None, None),)
    MeasuredPSFs(bank, torch.zeros_like(bank.psfs), distances, reports).save(folder / "measured.safetensors")
    frames = folder / "frames"
    columns = "".join(f"{level};{level / 40.6:.6f}\n" for level in range(256))
    (folder / "columns.csv").write_text(f"Level;Phase (rad)\n{columns}")

    def read_frames(path: Path) -> object:
        return read_slm_frames(path.parent)

    def read_levels(path: Path) -> object:
        return read_response(path, bits=8)

    return [
        Case("npy", "npy", folder / "heights.npy", read_heights),
        Case("safetensors", "safetensors", folder / "heights.safetensors", read_heights),
        Case("safetensors", "safetensors", folder / "camera.safetensors", load_camera),
        Case("safetensors", "safetensors", folder / "bank.safetensors", PSFBank.load),
        Case("safetensors", "safetensors", folder / "measured.safetensors", MeasuredPSFs.load),
        Case("frames", "json", frames / "frames.json", read_frames, frames),
        Case("frames", "npy", frames / "turns.npy", read_frames, frames),
        Case("frames", "png", frames / "frame_000.png", read_frames, frames),
        Case("response", "raw", folder / "lut.txt", read_levels),
        Case("response", "raw", folder / "columns.csv", read_levels),
    ]


def _systems(folder: Path) -> list[Case]:
    """Checkpoints, settings and weights."""
    plain = folder / "plain.safetensors"
    torch.save({"conv.weight": torch.zeros(3, 4)}, folder / "midas.pt")
    hub = save_pretrained(load_trained(plain), folder / "hub", record={})
    load_trained(plain).settings.write(folder / "settings.json")
    wrapped = folder / "refocused.safetensors"
    return [
        *(Case("checkpoint", "checkpoint", path, load_trained) for path in (plain, wrapped)),
        *(Case("state", "checkpoint", plain, read_state) for _ in range(2)),
        Case("checkpoint", "json", hub / "config.json", _from_folder, hub),
        Case("checkpoint", "safetensors", hub / "model.safetensors", _from_folder, hub),
        Case("run", "json", folder / "settings.json", SystemSettings.read),
        Case("weights", "raw", folder / "midas.pt", load_midas_small),
    ]  # fmt: skip


def _from_folder(path: Path) -> object:
    return from_pretrained(path.parent)


def _calibrations(folder: Path) -> list[Case]:
    """Calibrations and noise profiles."""
    folder.mkdir()
    (folder / "calib.txt").write_text("cam0=[3997.5 0 1176.7; 0 3997.5 1011.7; 0 0 1]\ndoffs=131.25\nbaseline=193.5\n")
    (folder / "calib.json").write_text('{"focal_px": 3997.5, "baseline_m": 0.1935, "doffs_px": 131.25}')
    line = TransferLine(2.0, 0.01, 6.0, 0.1, 0.0, 0.999, 10000)
    names = CurvePoint.__dataclass_fields__
    point = CurvePoint(**{name: "G" if "str" in str(names[name].type) else 2 for name in names})
    noise = PhotonTransfer("a", 100.0, "flats", 64.0, 4095.0, line, {"G": line}, (point,))
    write_json(folder / "noise.json", noise)
    return [
        Case("calibration", "text", folder / "calib.txt", read_calibration),
        Case("calibration", "json", folder / "calib.json", read_calibration),
        Case("noise", "json", folder / "noise.json", lambda path: read_noise(path).sensor_noise()),
        *_lenses(folder),
    ]


def _lenses(folder: Path) -> list[Case]:
    """Lenses: prescriptions of optical programs, a Zernike table, and a table of this package."""

    def traced(path: Path) -> Lens:
        return Lens.from_prescription(path, 8.0, 0.6, wavelengths=[530e-9], field=4e-3)

    cases = []
    for suffix, write in WRITERS.items():
        path = folder / f"lens{suffix}"
        path.write_text(write(doublet()))
        cases.append(Case("lens", "json" if suffix.endswith("json") else "text", path, traced))
    table, file = folder / "lens.csv", folder / "lens.safetensors"
    table.write_text("field_mm,wavelength_nm,Z4,Z7\n0,530,0.1,0.0\n2.5,530,0.1,0.2\n5,530,0.1,0.4\n")
    Lens.from_seidel(50e-3, 8.0, 0.6, 5e-3, coma=1.0).save(file)
    cases.append(Case("lens", "text", table, lambda path: Lens.from_zernike_table(path, 50e-3, 8.0, 0.6)))
    return [*cases, Case("lens", "safetensors", file, Lens.load)]


def _folders(folder: Path) -> list[Case]:
    """Data sets in folders."""
    rgbd, captures, shards = folder / "rgbd", folder / "captures", folder / "shards"
    optics, scenes = TiDyOptics(fidelity="draft"), DeadLeaves(2, 24, 24, num_leaves=20)
    layout, packed = Layout(beside=("depth",)), Layout(shard_items=2)
    render_scenes(optics, scenes, captures, layout)
    render_scenes(optics, scenes, shards, packed)
    parts = packed.parts(2)
    tum, nyu, frozen = folder / "tum", folder / "nyu", folder / "frozen"
    tum.mkdir()
    shutil.copy(rgbd / "lamp.png", tum / "a.png")
    shutil.copy(rgbd / "lamp_depth.png", tum / "b.png")
    for name, file in (("rgb", "a"), ("depth", "b")):
        (tum / f"{name}.txt").write_text(f"# time file\n1.5 {file}.png\n")
    nyu.mkdir()
    write_nyu(nyu, 2)
    NoiseFreeCaptures(scenes, optics, frozen)[0]
    (shards / "sample.json").write_bytes(b'{"index": 3, "name": "lamp"}')

    def first(path: Path, of: Callable[[Path], Any]) -> object:
        return of(path.parent)[0]

    def sample(path: Path) -> object:
        return decode_sample({"scene.json": path.read_bytes(), "coded.npy": (folder / "depth.npy").read_bytes()})

    return [
        Case("folder", "json", rgbd / "rgbd.json", lambda path: first(path, described_folder), rgbd),
        Case("folder", "text", tum / "rgb.txt", lambda path: first(path, TUMSequence), tum),
        *(Case("index", "text", place / "index.csv", lambda path: first(path, CodedCaptures), place)
          for place in (captures, shards)),
        Case("index", "raw", shards / parts[0].name, lambda path: first(path, CodedCaptures), shards),
        Case("index", "tar", shards / parts[0].name, lambda path: encode_index(path.parent, parts, packed)),
        Case("index", "json", shards / "sample.json", sample),
        Case("nyu", "hdf5", nyu / "nyu_depth_v2_labeled.mat", lambda path: NYUDepthV2(path.parent, "all")[0], nyu),
        Case("nyu", "raw", nyu / "splits.mat", lambda path: first(path, NYUDepthV2), nyu),
        Case("npy", "npy", frozen / "000000.npy",
             lambda path: NoiseFreeCaptures(scenes, optics, path.parent)[0], frozen),
    ]  # fmt: skip


def _runs(folder: Path) -> list[Case]:
    """Logs and summaries of a training run."""
    folder.mkdir()
    (folder / "validation.csv").write_text("epoch,step,val_loss,val_image_psnr\n0,10,0.5,20.0\n1,20,0.4,21.5\n")
    (folder / "training.csv").write_text("epoch,step,loss\n0,5,0.5\n0,10,0.45\n1,20,0.4\n")
    (folder / "evaluation.json").write_text(
        '{"settings": {"data": "nyu"}, "split": "test", "scenes": 3, "mean": {"image_psnr": 20.5, "depth_rmse": 0.1}}'
    )
    return [
        *(Case("run", damage, folder / name, lambda path: training_record(path.parent), folder)
          for name, damage in (("validation.csv", "text"), ("evaluation.json", "json"))),
        Case("run", "text", folder / "training.csv", lambda path: drop_rows_after(path, 10)),
        *(Case("figure", "text", folder / name, _draw, folder) for name in ("validation.csv", "training.csv")),
    ]  # fmt: skip


def _draw(path: Path) -> None:
    import matplotlib.pyplot as plt

    plt.close(draw_learning_curve(path.parent))


def _raw_files(folder: Path) -> list[Case]:
    """A DNG by its tags alone, which are read in this process; whole raw files take a process each."""
    path = folder / "a.dng"
    path.write_bytes(dng(np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) + 64))

    def read_tags(path: Path) -> None:
        data = path.read_bytes()
        camera_tags(data)
        directories = list(tiff_directories(data))
        missing_bytes(data, directories)
        sensor = dng_sensor(data, directories)
        if sensor is not None:
            ignored_opcodes(data, sensor)

    return [Case("tags", "tiff", path, read_tags), Case("raw", "tiff", path, RawCapture.open)]
