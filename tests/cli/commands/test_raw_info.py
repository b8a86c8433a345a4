from __future__ import annotations

import numpy as np
import pytest

from kornia_tidy.cli import main
from tests.base import BaseTester, shared
from tests.lab.raw.dng import UNDEFINED, dng
from tests.lab.raw.dng_kinds import gain_map


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A good file, one that is cut short and a dump of counts, in the folder in which the command runs."""
    counts = np.random.default_rng(0).integers(64, 1000, (36, 48))
    (tmp_path / "good.dng").write_bytes(dng(counts, orientation=6))
    (tmp_path / "short.dng").write_bytes(dng(counts)[:-9])
    (tmp_path / "dump.raw").write_bytes(counts.astype("<u2").tobytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command):
    return main(["raw", *command.split()])


class TestRawInfo(BaseTester):
    def test_feature_in_words(self, folder, capsys):
        assert run("info good.dng") == 0
        assert capsys.readouterr().out.splitlines() == [
            "file      good.dng",
            "camera    Maker Model One, Prime 35",
            "exposure  1/25 s, f/2.8, 35 mm, ISO 400, 2024-02-29 12:34:56",
            "sensor    48 x 36 px, filter array RGGB",
            "levels    black 64, white 1023; counts 64 to 999, 0 % of them at white or above",
            "colour    white balance R 2 G 1 B 1.6 G 1; camera_to_srgb",
            "picture   is to be turned by 90 degrees clockwise",
            "",
        ]

    def test_feature_a_bad_file_never_hides_the_others(self, folder, capsys):
        assert run("info short.dng good.dng none.dng good.dng") == 2
        told = capsys.readouterr()
        assert told.out.count("Maker Model One") == 2
        assert told.err.splitlines() == [
            "kornia-tidy: error: cannot read short.dng: it is cut short, 9 bytes of its picture are missing",
            "kornia-tidy: error: cannot read none.dng: there is no such file",
            "kornia-tidy: error: 2 of 4 files failed",
        ]

    @pytest.mark.filterwarnings("default::UserWarning")
    def test_feature_opcodes_that_are_not_applied(self, folder, capsys):
        counts = np.random.default_rng(0).integers(64, 1000, (36, 48))
        (folder / "phone.dng").write_bytes(dng(counts, extra={51009: (UNDEFINED, gain_map())}))
        assert run("info phone.dng") == 0
        told = capsys.readouterr()
        assert "opcodes   GainMap (optional): not applied\n" in told.out
        assert told.err.count("warning: phone.dng: its opcodes GainMap (optional) are not applied") == 1

    @pytest.mark.filterwarnings("default::UserWarning")
    def test_feature_a_white_level_that_lies_is_told_once(self, folder, capsys):
        counts = np.random.default_rng(0).integers(64, 54999, (36, 48))
        counts[0, 0] = 54998
        (folder / "lie.dng").write_bytes(dng(counts, white=255))
        assert run("info lie.dng lie.dng") == 0
        told = capsys.readouterr()
        assert told.out.count("black 64, white 54998; counts") == 2
        assert told.err == (
            "kornia-tidy: warning: lie.dng: its white level 255 is wrong, as its counts reach 54998, which is taken "
            "for white: if you know the right one, give it (white=..., --white N)\n"
        )
        assert run("info lie.dng --white 60000") == 0
        told = capsys.readouterr()
        assert "white 60000" in told.out
        assert told.err == ""

    def test_feature_a_dump_once_it_is_described(self, folder, capsys):
        assert run("info dump.raw") == 2
        assert "if it is a bare dump of the counts, give its size" in capsys.readouterr().err
        assert run("info dump.raw --size 48x36 --pattern gbrg --black 1 2 3 4 --white 1023") == 0
        told = capsys.readouterr().out
        assert "48 x 36 px, filter array GBRG" in told
        assert "black 1 2 3 4, white 1023" in told
        assert run("info dump.raw --size 48x36 --pattern none --black 0 --white 1023") == 0
        assert "monochrome" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("options", "reason"),
        [
            ("--black 10", "--black is for bare dumps of counts: give --size too"),
            ("--white 1023", "if it is a bare dump of the counts, give its size"),
            ("--size 48x36 --pattern RGGB --black 0", "a bare dump of counts needs --white"),
            ("--size 48x35 --pattern RGGB --black 0 --white 9", "48 x 35 counts of uint16 take 3360 bytes, it has"),
        ],
    )
    def test_exception_of_dumps(self, options, reason, folder, capsys):
        assert run(f"info dump.raw {options}") == 2
        told = capsys.readouterr()
        assert reason in told.err
        assert told.err.count("\n") == 1
        assert told.out == ""

    def test_exception_of_real_files_is_one_sentence_each(self, capsys):
        folders = [shared(f"data/raw/{name}", {"*": 1}) for name in ("serptools+testdata", "mushfiqulalam+isp")]
        paths = [str(path) for folder in folders for path in sorted(folder.glob("*"))]
        assert main(["raw", "info", *paths]) == 2
        told = capsys.readouterr()
        assert told.out == ""
        assert told.err.count("cannot read") == len(paths) == told.err.count("\n") - 1
