"""Orientation of photographs: found wherever other programs write it, told, and undone as the warning says."""

from __future__ import annotations

import io
import re
import struct
import warnings
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from kornia_tidy.data import PhotoCollages, read_depth, read_image, read_rgbd, write_depth
from kornia_tidy.data.orientation import orientation_of
from tests.base import BaseTester

SIZES = [(24, 32), (24, 24)]  # rows and columns; a square picture fits in any orientation
FORMATS = ("JPEG", "PNG", "WEBP")


def photo(size=(24, 32)):
    """A picture whose eight orientations differ."""
    rows, columns = np.indices(size)
    return Image.fromarray(np.uint8(1 + 3 * rows + 2 * columns))


def encoded(kind, **options):
    """Bytes of the picture as Pillow writes it."""
    file = io.BytesIO()
    photo(options.pop("size", (24, 32))).save(file, kind, **options)
    return file.getvalue()


def exif(orientation, order="<", kind=3):
    head = b"II*\0" if order == "<" else b"MM\0*"
    value = struct.pack(order + {3: "HH", 4: "I"}[kind], *([orientation, 0] if kind == 3 else [orientation]))
    fields = struct.pack(f"{order}HHI", 0x010F, 2, 4) + b"cam\0" + struct.pack(f"{order}HHI", 0x0112, kind, 1) + value
    return head + struct.pack(f"{order}IH", 8, 2) + fields + bytes(4)


def segment(data, marker=0xE1):
    return bytes((0xFF, marker)) + struct.pack(">H", len(data) + 2) + data


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def riff(*chunks):
    body = b"WEBP" + b"".join(
        kind + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2) for kind, data in chunks
    )
    return b"RIFF" + struct.pack("<I", len(body)) + body


XMP = b'<x:xmpmeta><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'
XMP_ELEMENT = b"<x:xmpmeta><tiff:Orientation>6</tiff:Orientation></x:xmpmeta>"
PROFILE = b"\nexif\n      42\n" + (b"Exif\0\0" + exif(6)).hex().encode() + b"\n"


def carriers():
    """Files that say 6 in the ways of other programs, by name."""
    jpeg, png = encoded("JPEG"), encoded("PNG")
    webp = encoded("WEBP", lossless=True)
    app1 = b"Exif\0\0"
    for name, before in {
        "first": segment(app1 + exif(6)),
        "big-endian": segment(app1 + exif(6, ">")),
        "long": segment(app1 + exif(6, ">", 4)),
        "after another APP1": segment(b"http://ns.adobe.com/xap/1.0/\0<x/>") + segment(app1 + exif(6)),
        "XMP": segment(b"http://ns.adobe.com/xap/1.0/\0" + XMP),
        "XMP element": segment(b"http://ns.adobe.com/xap/1.0/\0" + XMP_ELEMENT),
        "EXIF before XMP": segment(b"http://ns.adobe.com/xap/1.0/\0" + XMP.replace(b"6", b"3"))
        + segment(app1 + exif(6)),
    }.items():
        yield f"JPEG {name}", jpeg[:2] + before + jpeg[2:]
    yield "JPEG after JFIF", jpeg[:20] + segment(app1 + exif(6)) + jpeg[20:]
    for name, part in {
        "eXIf": chunk(b"eXIf", exif(6, ">")),
        "eXIf with a prefix": chunk(b"eXIf", app1 + exif(6)),
        "tEXt": chunk(b"tEXt", b"Raw profile type exif\0" + PROFILE),
        "zTXt": chunk(b"zTXt", b"Raw profile type exif\0\0" + zlib.compress(PROFILE)),
        "iTXt": chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + XMP),
    }.items():
        yield f"PNG {name}", png[:33] + part + png[33:]
        yield f"PNG {name}, behind", png[:-12] + part + png[-12:]
    bits = (b"VP8L", webp[20:])
    head = (b"VP8X", b"\x08\0\0\0" + (31).to_bytes(3, "little") + (23).to_bytes(3, "little"))
    for name, part in {
        "EXIF": (b"EXIF", exif(6)),
        "EXIF with a prefix": (b"EXIF", app1 + exif(6)),
        "XMP": (b"XMP ", XMP),
    }.items():
        yield f"WebP {name}", riff(head, bits, part)


class TestOrientation(BaseTester):
    @pytest.mark.parametrize(("name", "data"), list(carriers()), ids=[name for name, _ in carriers()])
    def test_feature_found_wherever_other_programs_write_it(self, name, data, tmp_path):
        assert orientation_of(data) == 6
        (tmp_path / "a").write_bytes(data)
        with pytest.warns(UserWarning, match="orientation 6"):
            assert read_image(tmp_path / "a").shape[1:] == (24, 32)

    @pytest.mark.parametrize("kind", FORMATS)
    def test_feature_upright_and_damaged_metadata_tell_nothing(self, kind):
        whole = exif(6)
        for block in (b"", exif(1), exif(0), exif(9), whole[:12], whole[:9], whole[:4] + b"\xff" * 4 + whole[8:]):
            data = encoded(kind, exif=block) if block else encoded(kind)
            assert orientation_of(data) == 1
            assert orientation_of(data[:40]) == 1

    @pytest.mark.parametrize("size", SIZES)
    @pytest.mark.parametrize("kind", FORMATS)
    @pytest.mark.parametrize("orientation", range(2, 9))
    def test_feature_the_remedy_brings_upright_depth_to_the_stored_pixels(self, orientation, kind, size, tmp_path):
        """Against Pillow, which turns the picture upright as viewers do."""
        tag = Image.Exif()
        tag[0x0112] = orientation
        path = tmp_path / "a.jpg"
        path.write_bytes(encoded(kind, size=size, exif=tag, **({"lossless": True} if kind == "WEBP" else {})))
        upright = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("L"))
        with pytest.warns(UserWarning, match=rf"a\.jpg is stored .* \(orientation {orientation}\)") as told:
            stored = read_image(path)
        assert stored.shape[1:] == size
        remedy = re.search(r"same form with (.*), or save", str(told[0].message))[1]
        found = eval(remedy, {"np": np, "depth": upright})
        np.testing.assert_allclose(stored[0] * 255, found, atol=1.5 if kind == "WEBP" else 1e-3)

    @pytest.mark.parametrize("orientation", range(2, 9))
    def test_feature_depth_is_told_with_the_remedy_for_it(self, orientation, tmp_path):
        tag = Image.Exif()
        tag[0x0112] = orientation
        path = tmp_path / "depth.png"
        path.write_bytes(encoded("PNG", exif=tag))
        with pytest.warns(UserWarning, match=r"depth\.png is stored .*if its picture is upright") as told:
            depth = read_depth(path).depth[0].numpy()
        remedy = re.search(r"same form with (.*)$", str(told[0].message))[1]
        upright = np.asarray(ImageOps.exif_transpose(Image.open(path)), np.float32)
        np.testing.assert_array_equal(eval(remedy, {"np": np, "depth": depth}), upright)

    def test_feature_told_once_for_each_folder_size_and_orientation(self, tmp_path):
        for number, (orientation, size) in enumerate([(6, (24, 32)), (6, (24, 32)), (3, (24, 32)), (6, (24, 24))]):
            block = exif(orientation)
            (tmp_path / f"{number}.jpg").write_bytes(encoded("JPEG", size=size, exif=b"Exif\0\0" + block))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for path in 2 * sorted(tmp_path.iterdir()):
                read_image(path)
        assert [str(one.message).split(" is ")[0][-5:] for one in told] == ["0.jpg", "2.jpg", "3.jpg"]
        assert told[0].filename == __file__

    def test_feature_photographs_without_depth_are_silent_in_collages(self, tmp_path):
        (tmp_path / "a.jpg").write_bytes(encoded("JPEG", size=(300, 400), exif=b"Exif\0\0" + exif(6)))
        PhotoCollages([tmp_path / "a.jpg"], 1, 32, 32)[0]

    @pytest.mark.parametrize("resample", [None, "depth"])
    def test_exception_depth_of_the_upright_picture_names_the_turn(self, resample, tmp_path):
        (tmp_path / "a.jpg").write_bytes(encoded("JPEG", exif=b"Exif\0\0" + exif(8)))
        write_depth(tmp_path / "d.pfm", torch.ones(1, 32, 24))
        with (
            pytest.warns(UserWarning, match="orientation 8"),
            pytest.raises(
                ValueError, match=r"a\.jpg is stored rotated by 90 degrees clockwise .*np\.rot90\(depth, -1\)"
            ),
        ):
            read_rgbd(tmp_path / "a.jpg", tmp_path / "d.pfm", resample=resample)
