"""No code from any file is run: pickles and expressions under every name, through every reader and every command."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import sys

import pytest

from kornia_tidy import cli
from tests.base import BaseTester
from tests.hostile.payloads import MARKER, payloads
from tests.mutations.readers import make_readers
from tests.mutations.reading import try_read

SCENES = ("--data", "dead-leaves", "--size", "32", "--scenes", "1", "-o", "OUT")
COMMANDS = (
    ("simulate", "IN", "--depth", "IN", "-o", "OUT.png"),
    ("psf", "IN", "-o", "OUT.png"),
    ("systems", "--image", "IN", "--depth", "IN", "-o", "OUT.png"),
    ("masks", "show", "IN"),
    ("masks", "export", "IN", "-o", "OUT.npy"),
    ("masks", "import", "FOLDER", "-o", "OUT.npy"),
    ("raw", "info", "IN"),
    ("raw", "develop", "IN", "-o", "OUT"),
    ("raw", "reconstruct", "IN", "--head", "IN", "-o", "OUT"),
    ("raw", "calibrate-noise", "IN", "-o", "OUT.json"),
    ("raw", "simulate", "--image", "IN", "--depth", "IN", "--noise", "IN", "-o", "OUT.dng"),
    ("render", "--checkpoint", "IN", "--split", "test", *SCENES),
    ("render", "--data", "rgbd-folder", "--root", "FOLDER", "-o", "OUT"),
    ("evaluate", "IN", *SCENES),
    ("train", "--head-from", "IN", "--epochs", "1", *SCENES),
    ("train", "--resume", "--epochs", "1", *SCENES[:-1], "FOLDER"),
    ("trade", "--image", "IN", "--depth", "IN", "-o", "OUT"),
    ("demo", "--image", "IN", "--depth", "IN", "-o", "OUT.png"),
)


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    return make_readers(tmp_path_factory.mktemp("whole"))


def silent(argv):
    """Run a command; return its exit status and what it said."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            status = cli.main(argv)
        except SystemExit as left:
            status = left.code
    return status, said.getvalue()


class TestPayloads(BaseTester):
    def test_smoke_a_pickle_does_run_its_code(self, tmp_path):
        """Else the other tests would show nothing."""
        pickle.loads(payloads(tmp_path)["pickle"])
        assert (tmp_path / MARKER).is_dir()

    def test_exception_no_reader_runs_a_file(self, readers, tmp_path):
        (tmp_path / "marker").mkdir()
        for name, data in payloads(tmp_path / "marker").items():
            for case in (case for cases in readers.values() for case in cases):
                result, said = try_read(case, data, tmp_path)
                assert result != "failed", (name, case.source.name, said)
                assert not any((tmp_path / "marker").iterdir()), (name, case.source.name)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("argv", COMMANDS, ids=lambda argv: " ".join(argv[:2]))
    def test_exception_no_command_runs_a_file(self, argv, tmp_path):
        (tmp_path / "marker").mkdir()
        made = payloads(tmp_path / "marker")
        for number, name in enumerate(("objects in NPY", "torch.save, new")):  # all go to the readers, see above
            data = made[name]
            folder = tmp_path / f"{number}"
            folder.mkdir()
            for file in ("rgbd.json", "frames.json", "settings.json", "last.safetensors", "evil.npy"):
                (folder / file).write_bytes(data)
            places = {"IN": str(folder / "evil.npy"), "FOLDER": str(folder), "OUT": str(tmp_path / f"out{number}")}
            words = [places.get(word, word.replace("OUT.", f"{places['OUT']}.")) for word in argv]
            status, said = silent(words)
            assert status == 2, (name, said)
            assert "Traceback" not in said
            assert "usage" not in said
            assert not any((tmp_path / "marker").iterdir()), name

    def test_exception_a_checkpoint_that_names_a_head_imports_nothing(self, readers, tmp_path, monkeypatch):
        """Through a checkpoint and through a folder of the hub; the module lies where Python would find it."""
        (tmp_path / "evil_head.py").write_text(f"import os\nos.mkdir({str(tmp_path / MARKER)!r})\n")
        monkeypatch.syspath_prepend(tmp_path)
        for case in (case for case in readers["checkpoint"] if case.source.name != "model.safetensors"):
            data = case.source.read_bytes()
            if case.damage == "json":
                document = json.loads(data)
                document["settings"]["head"] = "evil_head:Head"
                evil = json.dumps(document).encode()
            else:
                size = int.from_bytes(data[:8], "little")
                header = json.loads(data[8 : 8 + size])
                state = json.loads(header["__metadata__"]["state"])
                state["settings"]["head"] = "evil_head:Head"
                header["__metadata__"]["state"] = json.dumps(state)
                coded = json.dumps(header).encode()
                evil = len(coded).to_bytes(8, "little") + coded + data[8 + size :]
            result, said = try_read(case, evil, tmp_path)
            assert result == "refused"
            assert "evil_head" in said
            assert "evil_head" not in sys.modules
            assert not (tmp_path / MARKER).exists()
