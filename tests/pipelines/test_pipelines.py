"""Twenty typical pipelines, each as its user has it and with the camera put in. The table is in README.md."""

from __future__ import annotations

import gc
import importlib
import io
import re
import sys
import tarfile
from collections.abc import Callable
from itertools import cycle
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
FLAT = "torchvision_classification_reference"  # has no depth
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


FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "rows and columns of the depth swapped": lambda depth: np.ascontiguousarray(depth.T),
    "all depth unknown": np.zeros_like,
}


def write_scenes(root: Path, fault: str | None = None) -> None:
    """Three scenes of noise over a ramp of depth, 0.4 to 2 m, as files and as a shard."""
    for kind in ("rgb", "depth"):
        (root / "scenes" / kind).mkdir(parents=True)
    ramp = np.linspace(400, 2000, 80)[None].repeat(64, 0).round().astype(np.uint16)
    ramp = ramp if fault is None else FAULTS[fault](ramp)
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


def compare(before: dict[str, Any], after: dict[str, Any], name: str) -> None:
    """Assert that the camera took the picture, and left form, type and depth as they were."""
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


@pytest.fixture
def script(request, tmp_path, monkeypatch):
    """A script whose libraries are installed, in a folder of its own, where its scenes can be written."""
    text = (SCRIPTS / f"{request.param}.py").read_text()
    for library in LIBRARIES:
        if re.search(rf"^(import|from) {library}\b", text, flags=re.MULTILINE):
            need(library, module=False)
    if re.search(r"torchvision|deepinv|lightning", text):
        need_torchvision(module=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(SCRIPTS))
    importlib.import_module("scenes_of_user")
    monkeypatch.setattr(TiDyOptics, "__init__", draws_kept(TiDyOptics.__init__))
    yield request.param, text
    sys.modules.pop("scenes_of_user", None)
    gc.collect()  # closes what a script that ended in an error left open, while its warnings are ignored


@pytest.mark.parametrize("script", NAMES, indirect=True)
def test_feature_runs_with_two_lines_changed(script, tmp_path):
    name, text = script
    write_scenes(tmp_path)
    before = run(original(text), f"{name} before")
    after = run(text, f"{name} after")
    compare(before, after, name)


@pytest.mark.parametrize(("script", "fault"), [*zip(sorted({*NAMES} - {FLAT}), cycle(FAULTS))], indirect=["script"])
def test_exception_a_depth_that_cannot_be_right_is_told(script, fault, tmp_path):
    """Each script meets one of the faults."""
    name, text = script
    write_scenes(tmp_path, fault)
    told = (
        "depth|Height and Width of image, mask or masks|multiple HxW dimensions"  # by us, albumentations, torchvision
    )
    with pytest.raises((ValueError, RuntimeError), match=told):
        run(text, name)


@pytest.mark.parametrize("fault", ["no picture taken", "another form", "depth moved", "depth in another type", "NaN"])
def test_exception_the_comparison_sees_a_fault(fault):
    """Otherwise the tests above would say nothing."""
    image, depth = torch.rand(1, 3, 8, 9), torch.rand(1, 1, 8, 9) + 1
    before, after = {"image": image, "depth": depth}, {"image": 1 - image, "depth": depth}
    compare(before, after, "")
    changes_of = {
        "no picture taken": {"image": image},
        "another form": {"image": 1 - image[0]},
        "depth moved": {"depth": depth.flip(-1)},
        "depth in another type": {"depth": depth.double()},
        "NaN": {"image": image * torch.nan},
    }
    with pytest.raises(AssertionError):
        compare(before, after | changes_of[fault], "")


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
