"""Twenty typical pipelines, each as its user has it and with the camera put in. The table is in README.md."""

from __future__ import annotations

import importlib
import io
import re
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy import TiDyOptics
from tests.augmentation.optional import need, need_torchvision

SCRIPTS = Path(__file__).parent / "scripts"
NAMES = sorted(path.stem for path in SCRIPTS.glob("*.py") if path.stem != "scenes_of_user")
LIBRARIES = ("torchvision", "albumentations", "lightning", "datasets", "monai", "deepinv", "webdataset")
TRAINED = {"kornia_augmentation_in_training_step", "lightning_module", "pytorch_training_loop"}

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


def original(text: str) -> str:
    """The script without the camera: lines that end in "# new" go, and a line after "# was: ..." is what it was."""
    text = re.sub(r"^.*# new\n", "", text, flags=re.MULTILINE)
    return re.sub(r"^( *)# was: (.*)\n.*\n", r"\1\2\n", text, flags=re.MULTILINE)


def changes(text: str) -> tuple[int, int]:
    """Lines changed, and imports among them."""
    lines = [line for line in text.splitlines() if line.endswith("# new")]
    imports = sum(line.lstrip().startswith(("import ", "from ")) for line in lines)
    return len(lines) + len(re.findall(r"^ *# was: ", text, flags=re.MULTILINE)), imports


def write_scenes(root: Path) -> None:
    """Three scenes of noise over a ramp of depth, 0.4 to 2 m, as files and as a shard."""
    for kind in ("rgb", "depth"):
        (root / "scenes" / kind).mkdir(parents=True)
    ramp = np.linspace(400, 2000, 80)[None].repeat(64, 0).round().astype(np.uint16)
    noise = np.random.default_rng(0)
    with tarfile.open(root / "scenes.tar", "w") as shard:
        for index in range(3):
            picture = noise.integers(0, 256, (64, 80, 3), dtype=np.uint8)
            array = io.BytesIO()
            np.save(array, (ramp / 1e3).astype(np.float32))
            files = {"png": cv2.imencode(".png", picture)[1].tobytes(), "npy": array.getvalue()}
            for end, data in files.items():
                entry = tarfile.TarInfo(f"{index}.{end}")
                entry.size = len(data)
                shard.addfile(entry, io.BytesIO(data))
            cv2.imwrite(str(root / f"scenes/rgb/{index}.png"), picture)
            cv2.imwrite(str(root / f"scenes/depth/{index}.png"), ramp)


def run(text: str, name: str) -> dict[str, Any]:
    """What a script leaves in its names."""
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002 - the generator that MONAI's users seed
    made: dict[str, Any] = {"__name__": name}
    exec(compile(text, name, "exec"), made)
    return made


def form(value: Any) -> tuple[Any, ...]:
    """Type, number type and shape."""
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return type(value).__name__, value.dtype, tuple(value.shape)
    return "PIL", value.mode, value.size


def draws_kept(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with torch's generator as it was after it, so that both runs of a script flip and crop alike."""

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        with torch.random.fork_rng():
            return function(*args, **kwargs)

    return wrapped


def plain(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)


@pytest.mark.parametrize("name", NAMES)
def test_feature_runs_with_two_lines_changed(name, tmp_path, monkeypatch):
    text = (SCRIPTS / f"{name}.py").read_text()
    for library in LIBRARIES:
        if re.search(rf"^(import|from) {library}\b", text, flags=re.MULTILINE):
            need(library, module=False)
    if re.search(r"torchvision|deepinv|lightning", text):
        need_torchvision(module=False)
    write_scenes(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(SCRIPTS))
    importlib.import_module("scenes_of_user")
    monkeypatch.setattr(TiDyOptics, "__init__", draws_kept(TiDyOptics.__init__))
    try:
        before, after = run(original(text), f"{name} before"), run(text, f"{name} after")
    finally:
        sys.modules.pop("scenes_of_user", None)
    if "image" in before:
        assert form(after["image"]) == form(before["image"])
        assert not np.array_equal(plain(after["image"]), plain(before["image"]))
        assert np.isfinite(plain(after["image"])).all()
    if "depth" in before:
        given, kept = plain(before["depth"]), plain(after["depth"])
        assert kept.dtype == given.dtype
        assert np.array_equal(kept[given > 0], given[given > 0])  # holes, which a warp leaves 0, may be filled
    if name in TRAINED:
        gradient = after["trained"].optics.masks.phase.grad
        assert gradient is not None
        assert gradient.isfinite().all()
        assert gradient.abs().sum() > 0


@pytest.mark.parametrize("name", NAMES)
def test_feature_two_lines_besides_imports(name):
    every, imports = changes((SCRIPTS / f"{name}.py").read_text())
    assert 1 <= every - imports <= 2
    assert "kornia_tidy" not in original((SCRIPTS / f"{name}.py").read_text())


def test_feature_twenty_and_each_in_the_table():
    table = (SCRIPTS.parent / "README.md").read_text()
    assert len(NAMES) == 20
    for name in NAMES:
        every, imports = changes((SCRIPTS / f"{name}.py").read_text())
        assert re.search(rf"scripts/{name}\.py\) \|.*\| {every - imports} \+ {imports} \|", table), name
