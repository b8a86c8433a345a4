"""STL export: the file is a closed body, read from its bytes as a slicer does."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kornia_tidy.lab.mask_export.printing import relief, write_stl
from tests.base import BaseTester

SURFACES = arrays(np.float64, st.tuples(st.integers(1, 5), st.integers(1, 5)), elements=st.floats(0.1, 9))


def read_stl(path) -> tuple[np.ndarray, np.ndarray]:
    """Read corners (T, 3, 3) and normals (T, 3) by the layout of the format."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    assert len(data) == 84 + 50 * count
    assert not data.startswith(b"solid")
    records = np.frombuffer(data[84:], np.uint8).reshape(count, 50)
    numbers = np.ascontiguousarray(records[:, :48]).view("<f4").reshape(count, 4, 3).astype(np.float64)
    return numbers[:, 1:], numbers[:, 0]


def volume(corners: np.ndarray) -> float:
    """Return the volume of a mesh by the divergence theorem."""
    return float(np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def check_closed(corners: np.ndarray) -> None:
    """Check that each edge belongs to two triangles of opposite direction, and that the body has no handle."""
    points = [[tuple(corner) for corner in triangle] for triangle in corners.tolist()]
    edges = Counter((t[i], t[(i + 1) % 3]) for t in points for i in range(3))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    vertices = {point for t in points for point in t}
    assert len(vertices) - len(edges) // 2 + len(points) == 2


class TestRelief(BaseTester):
    @settings(max_examples=60)
    @given(SURFACES, st.floats(0.5, 3))
    def test_feature_closed_and_with_the_volume_of_the_columns(self, columns, pitch):
        vertices, triangles = relief(columns, pitch)
        check_closed(vertices[triangles])
        assert volume(vertices[triangles]) == pytest.approx(columns.sum() * pitch**2, rel=1e-9)

    def test_feature_a_checkerboard_has_no_edge_of_four_triangles(self):
        vertices, triangles = relief(1.0 + np.indices((6, 6)).sum(0) % 2, 1.0)
        check_closed(vertices[triangles])

    def test_feature_pixels_are_flat_over_98_hundredths_of_their_width(self):
        columns = np.arange(1.0, 10).reshape(3, 3)
        vertices, triangles = relief(columns, 1.0)
        corners = vertices[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        flat = (normals[:, 2] > 0) & (np.ptp(corners[..., 2], axis=1) == 0)
        area = {height: normals[flat & (corners[:, 0, 2] == height), 2].sum() for height in columns.ravel()}
        assert area[5.0] == pytest.approx(0.99**2)
        assert area[1.0] == pytest.approx(0.995**2)


class TestWriteSTL(BaseTester):
    def test_exception(self, tmp_path):
        flat = torch.zeros(3, 3)
        with pytest.raises(ValueError, match="pupil_radius must be positive and finite metres, got 0"):
            write_stl(tmp_path / "m.stl", flat, 0)
        with pytest.raises(ValueError, match="heights must stay above the bottom of the plate, -1e-06 m, got -2e-06 m"):
            write_stl(tmp_path / "m.stl", flat - 2e-6, 1e-3, base=1e-6)
        with pytest.raises(ValueError, match="finite metres"):
            write_stl(tmp_path / "m.stl", flat / 0, 1e-3)
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            write_stl(tmp_path / "none" / "m.stl", flat, 1e-3)
        assert list(tmp_path.iterdir()) == []

    def test_feature_a_23_pixel_mask_in_millimetres(self, tmp_path):
        heights = 1.2e-6 * torch.rand(23, 23, dtype=torch.float64)
        write_stl(tmp_path / "m.stl", heights, pupil_radius=2e-3, base=0.5e-3)
        corners, normals = read_stl(tmp_path / "m.stl")
        check_closed(corners)
        assert corners.reshape(-1, 3).min(0) == pytest.approx([0, 0, 0])
        assert corners.reshape(-1, 3).max(0)[:2] == pytest.approx([4.6, 4.6])
        assert corners[..., 2].max() == pytest.approx(0.5 + float(heights.max()) * 1e3, abs=1e-7)
        expected = 0.2**2 * float((heights * 1e3 + 0.5).sum())
        assert volume(corners) == pytest.approx(expected, rel=1e-6)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("ti,ti->t", across, normals) > 0).all()
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=1e-6)

    def test_convention_seen_from_above_it_is_the_mask(self, tmp_path):
        """Columns have increasing x and rows decreasing y: a mask of 2 rows and 4 columns with one high pixel."""
        heights = torch.zeros(2, 4)
        heights[0, 3] = 1e-4
        write_stl(tmp_path / "m.stl", heights, pupil_radius=2e-3 / 2.3)  # pixels of 1 mm
        corners, _ = read_stl(tmp_path / "m.stl")
        high = corners[np.isclose(corners[..., 2], 1.1, atol=1e-6).all(1)]
        assert high.reshape(-1, 3).min(0)[:2] == pytest.approx([3.005, 1.005], abs=1e-6)
        assert high.reshape(-1, 3).max(0)[:2] == pytest.approx([4, 2], abs=1e-6)
