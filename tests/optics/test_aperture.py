import copy
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.camera import camera_of_state
from kornia_tidy.optics.aperture import OpenArea, annular_aperture, check_aperture, circular_aperture, light_through
from tests.base import BaseTester

both_edges = pytest.mark.parametrize("edges", ["binary", "area"])
fast = settings(max_examples=40)
sizes, pitches, radii = st.integers(1, 17), st.floats(0.05, 0.2), st.floats(0.5, 2.0)


def sampled_cover(size: int, pitch: float, inside, subdivisions: int = 64) -> torch.Tensor:
    """Return by brute force the fraction of each cell's sample points that satisfy inside(x, y)."""
    points = (np.arange(size * subdivisions) + 0.5) * pitch / subdivisions - size * pitch / 2
    hits = inside(points[None, :], points[:, None]).astype(float)
    return torch.from_numpy(hits.reshape(size, subdivisions, size, subdivisions).mean(axis=(1, 3)))


class TestCircularAperture(BaseTester):
    @both_edges
    @pytest.mark.parametrize("size", [1, 2, 23, 24])
    def test_cardinality(self, size, edges):
        aperture = circular_aperture(size, edges=edges)
        assert aperture.shape == (size, size)
        assert aperture.dtype == torch.float64

    @pytest.mark.parametrize("size", [0, -1, 2.5])
    def test_exception_size(self, size):
        with pytest.raises(ValueError, match=f"size must be a whole number of at least 1, got {size}"):
            circular_aperture(size)

    @pytest.mark.parametrize("value", [0.0, -0.1, math.nan, math.inf])
    def test_exception_lengths(self, value):
        with pytest.raises(ValueError, match=f"pitch must be positive and finite pupil radii, got {value}"):
            circular_aperture(23, pitch=value)
        with pytest.raises(ValueError, match=f"radius must be positive and finite pupil radii, got {value}"):
            circular_aperture(23, radius=value)

    def test_exception_edges(self):
        with pytest.raises(ValueError, match="edges must be one of 'binary', 'area', got 'soft'"):
            circular_aperture(23, edges="soft")

    def test_exception_a_disc_between_all_centres_lets_no_light_through(self):
        with pytest.raises(ValueError, match="must let some light through"):
            circular_aperture(4, pitch=1.0, radius=0.5)

    def test_feature_the_papers_grid_has_317_open_cells(self):
        """PhaseCam3D, 23 cells of 0.1: a disc of radius 10 on the integer lattice has N(10) = 317 points (Gauss)."""
        aperture = circular_aperture(23)
        assert aperture.sum() == 317
        assert aperture.unique().tolist() == [0, 1]
        assert aperture[1].sum() == aperture[21].sum() == 1  # the tips at rho = 1
        assert aperture[1, 11] == aperture[11, 1] == aperture[21, 11] == aperture[11, 21] == 1

    @pytest.mark.parametrize("cells", range(1, 12))
    def test_feature_binary_counts_are_those_of_the_gauss_circle_problem(self, cells):
        """OEIS A000328: lattice points within distance n of the origin, at pitches with different rounding."""
        points = (1, 5, 13, 29, 49, 81, 113, 149, 197, 253, 317, 377)[cells]
        for pitch in (0.1, 1 / 3, 1e-3):
            assert circular_aperture(27, pitch, radius=cells * pitch).sum() == points

    @pytest.mark.parametrize(("size", "pitch"), [(20, 0.1), (23, 0.1), (64, 1 / 32), (401, 0.005)])
    def test_feature_areas_add_up_to_the_disc(self, size, pitch):
        area = circular_aperture(size, pitch, edges="area").sum().item() * pitch**2
        assert area == pytest.approx(math.pi, abs=1e-12)

    @pytest.mark.parametrize(("size", "pitch", "radius"), [(7, 0.3, 1.0), (6, 0.37, 0.9), (4, 0.3, 0.7), (3, 1.0, 0.6)])
    def test_feature_a_cell_holds_its_covered_fraction(self, size, pitch, radius):
        """Against 64² points in each cell; the third disc reaches beyond its grid."""
        expected = sampled_cover(size, pitch, lambda x, y: x**2 + y**2 <= radius**2)
        self.assert_close(circular_aperture(size, pitch, radius, edges="area"), expected, rtol=0, atol=2e-3)


class TestAnnularAperture(BaseTester):
    @pytest.mark.parametrize("inner", [0.0, -0.1, 1.0, 2.0, math.nan])
    def test_exception_inner_lies_between_zero_and_the_radius(self, inner):
        with pytest.raises(ValueError, match=f"inner must be between 0 and the outer radius 1.0, got {inner}"):
            annular_aperture(23, 0.1, inner)

    def test_exception_a_ring_between_all_centres_lets_no_light_through(self):
        with pytest.raises(ValueError, match="must let some light through"):
            annular_aperture(23, 0.1, inner=0.97, radius=0.98)

    def test_feature_areas_add_up_to_the_ring(self):
        area = annular_aperture(23, 0.1, 0.37, edges="area").sum().item() * 0.1**2
        assert area == pytest.approx(math.pi * (1 - 0.37**2), abs=1e-12)

    def test_feature_a_cell_holds_its_covered_fraction(self):
        expected = sampled_cover(7, 0.3, lambda x, y: (x**2 + y**2 <= 1) & (x**2 + y**2 > 0.45**2))
        self.assert_close(annular_aperture(7, 0.3, 0.45, edges="area"), expected, rtol=0, atol=2e-3)

    @both_edges
    @given(inner=st.floats(0.1, 0.8))
    @example(inner=0.4444314715971388)  # whose square is less than its product with itself, by rounding
    @fast
    def test_property_ring_and_obstruction_make_the_disc(self, edges, inner):
        ring = annular_aperture(23, 0.1, inner, edges=edges)
        assert 0 <= ring.min() <= ring.max() <= 1
        whole = ring + circular_aperture(23, 0.1, inner, edges=edges)
        self.assert_close(whole, circular_aperture(23, edges=edges), rtol=0, atol=1e-12)


class TestCheckAperture(BaseTester):
    def test_feature_returns_the_values_in_float64(self, device, dtype):
        aperture = torch.rand(5, 5, device=device, dtype=dtype)
        checked = check_aperture(aperture, 5)
        assert checked.dtype == torch.float64
        assert checked.device == aperture.device
        assert torch.equal(checked, aperture.double())

    @pytest.mark.parametrize("value", [np.eye(3), np.eye(3) > 0, np.eye(3, dtype=np.uint8).tolist()])
    def test_feature_takes_arrays_booleans_and_lists(self, value):
        assert torch.equal(check_aperture(value, 3), torch.eye(3, dtype=torch.float64))

    def test_feature_later_edits_of_the_users_array_change_nothing(self):
        array = np.ones((3, 3))
        checked = check_aperture(array, 3)
        array[0, 0] = 0
        assert checked[0, 0] == 1

    def test_exception_shape(self, device, dtype):
        for shape in ((4, 5), (5,), (0, 5, 5), (1, 4, 5), (4, 4), (1, 1, 5, 5)):
            with pytest.raises(ValueError, match=r"aperture must have shape \(5, 5\), or \(K, 5, 5\) .* K masks, got"):
                check_aperture(torch.ones(shape, device=device, dtype=dtype), 5)

    @pytest.mark.parametrize("bad", [-0.5, 1.5, math.nan, math.inf, -math.inf])
    def test_exception_names_the_bad_value(self, bad, device, dtype):
        aperture = torch.ones(5, 5, device=device, dtype=dtype)
        aperture[2, 3] = bad
        with pytest.raises(ValueError, match=rf"amplitudes in \[0, 1\], got {bad}"):
            check_aperture(aperture, 5)

    def test_exception_a_closed_pupil_is_refused(self, device, dtype):
        with pytest.raises(ValueError, match="must let some light through, got 0 open cells"):
            check_aperture(torch.zeros(5, 5, device=device, dtype=dtype), 5)
        with pytest.raises(ValueError, match="must let some light through, got 0 open cells"):  # of one of two masks
            check_aperture(torch.stack([torch.zeros(5, 5), torch.ones(5, 5)]), 5)

    def test_exception_a_complex_pupil_is_refused(self, device):
        with pytest.raises(TypeError, match="real amplitude"):
            check_aperture(torch.ones(5, 5, device=device, dtype=torch.complex64), 5)

    def test_feature_open_areas_stay_open_areas(self):
        area = circular_aperture(5, 0.46, edges="area")
        assert isinstance(check_aperture(area, 5), OpenArea)
        assert not isinstance(check_aperture(0.9 * area, 5), OpenArea)


class TestOpenArea(BaseTester):
    @pytest.mark.parametrize(
        "aperture",
        [
            circular_aperture(23, edges="area"),
            annular_aperture(23, 0.1, 0.37, edges="area"),
        ],
    )
    def test_feature_light_is_the_open_area(self, aperture):
        assert torch.equal(light_through(aperture), torch.tensor(aperture.tolist(), dtype=torch.float64))
        graded = 1.0 * aperture
        assert type(graded) is torch.Tensor
        self.assert_close(light_through(graded), graded.square())
        for copied in (copy.deepcopy(aperture), pickle.loads(pickle.dumps(aperture))):
            assert isinstance(copied, OpenArea)
            assert copied.tolist() == aperture.tolist()

    def test_feature_shut_and_open_cells_are_the_same_either_way(self):
        binary = circular_aperture(23)
        assert not isinstance(binary, OpenArea)
        assert torch.equal(light_through(binary), light_through(binary.as_subclass(OpenArea)))

    def test_feature_a_camera_and_its_state_keep_it(self):
        area = circular_aperture(23, edges="area")
        optics = TiDyOptics(PixelwiseMask(1), fidelity="draft", aperture=area)
        assert optics.pupil.light == pytest.approx(math.pi, rel=1e-12)
        assert (
            copy.deepcopy(optics).pupil.light == camera_of_state(optics.state_dict()).pupil.light == optics.pupil.light
        )
        graded = TiDyOptics(PixelwiseMask(1), fidelity="draft", aperture=0.9 * area)
        assert graded.pupil.light == pytest.approx(0.81 * float((1.0 * area).square().sum()) * 0.01, rel=1e-12)
        graded.load_state_dict(optics.state_dict(), take_over=True)
        assert graded.pupil.light == optics.pupil.light

    def test_feature_a_state_of_before_keeps_its_captures_or_takes_the_light_of_the_camera_it_goes_to(self):
        """Such a state holds the numbers, and not that they are areas."""
        area = circular_aperture(23, edges="area")
        old = TiDyOptics(PixelwiseMask(1), fidelity="draft", aperture=1.0 * area)
        optics = TiDyOptics(PixelwiseMask(1), fidelity="draft", aperture=area)
        optics.load_state_dict(old.state_dict())
        optics.load_state_dict(old.state_dict(), take_over=True)
        assert isinstance(optics.aperture, OpenArea)
        assert camera_of_state(old.state_dict()).pupil.light == old.pupil.light
