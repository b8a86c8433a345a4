"""Tiles are not seen: against the same network on the whole image, and what cannot be tiled is refused."""

from __future__ import annotations

import functools
import weakref

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import (
    AttentionUNet,
    ClosedFormHead,
    JointHead,
    NAFNet,
    PhaseCam3DUNet,
    ReconstructionHead,
    receptive_field,
    reconstruct_tiled,
)
from kornia_tidy.reconstruction.head_memory import head_bytes
from kornia_tidy.reconstruction.heads import PlainHead
from kornia_tidy.reconstruction.receptive_field import maps_of
from kornia_tidy.reconstruction.tile_grid import TileGrid
from kornia_tidy.reconstruction.tiled import SEAM, shared_copy
from tests.base import BaseTester
from tests.reconstruction.test_any_camera import head_of as any_camera
from tests.reconstruction.test_closed_form import photo
from tests.reconstruction.test_closed_form_head import head_of, small
from tests.reconstruction.test_joint_closed_form import joint
from tests.reconstruction.test_layered_joint import stirred
from tests.reconstruction.test_refocused import Shown, refocused


class SmallUNet(ReconstructionHead):
    """Two levels, with every way up: nearest, transposed, and bilinear with corners aligned, as in MiDaS."""

    stride = 4

    def __init__(self, align_corners: bool = True) -> None:
        super().__init__(3, 2)
        self.first, self.second = nn.Conv2d(3, 4, 3, padding=1), nn.Conv2d(4, 6, 3, padding=1)
        self.up = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=align_corners)
        self.transposed = nn.ConvTranspose2d(6, 4, 2, stride=2)
        self.last = nn.Conv2d(8, 2, 3, padding=1)

    def predict(self, image):
        fine = self.first(image).relu()
        coarse = self.second(nn.functional.max_pool2d(fine, 4))
        return self.last(torch.cat([fine, self.up(self.transposed(coarse))], 1))


HEADS = {
    "plain": lambda: PlainHead(width=4),
    "attention": lambda: AttentionUNet(width=16),
    "phasecam3d": lambda: PhaseCam3DUNet(width=16),
    "nafnet": lambda: NAFNet(width=8),
    "joint": lambda: JointHead(AttentionUNet(out_channels=4, width=16)),
    "corners": SmallUNet,
}


@functools.cache
def trained(name):
    """A head whose normalisation is not the identity."""
    torch.manual_seed(0)
    head = HEADS[name]()
    generator = torch.Generator().manual_seed(1)
    for module in head.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1, generator=generator)
            module.running_var.uniform_(0.5, 2.0, generator=generator)
    for parameter in head.parameters():
        if not parameter.any():  # residual units start as zero, which would hide what is before them
            nn.init.normal_(parameter, std=0.05, generator=generator)
    return head.eval()


@torch.no_grad()
def seam(head, image, **options):
    """Largest difference of tiles from the whole; how many tiles there were; the largest value."""
    counted = []
    tiled = reconstruct_tiled(head, image, progress=lambda done, of: counted.append(of), **options)
    whole = head(image.contiguous(memory_format=torch.channels_last))
    assert type(tiled) is type(whole)
    difference = max(float((a - b).abs().max()) for a, b in zip(maps_of(tiled), maps_of(whole), strict=True))
    return difference, len(counted), max(float(part.abs().max()) for part in maps_of(whole))


class TestSeams(BaseTester):
    @pytest.mark.parametrize("name", ["plain", "corners"])
    @settings(max_examples=8)
    @given(st.integers(1, 150), st.integers(1, 150), st.integers(0, 60), st.integers(0, 60))
    def test_property_any_size_and_tile(self, name, height, width, more, and_more):
        """In float64, tiles barely larger than their overlap and such that hold the image."""
        head = trained(name).double()
        least = 2 * receptive_field(head) + 12
        image = torch.rand(1, 3, height, width, dtype=torch.float64)
        difference, _, _ = seam(head, image, tile=(least + more, least + and_more))
        head.float()
        assert difference <= 1e-12

    @pytest.mark.parametrize("encoded", [True, False])
    def test_feature_stray_light_is_that_of_the_whole_image(self, encoded):
        """Its left half is dark and its right half bright: by a tile's own light it would be wrong by .03 and more."""
        head = ClosedFormHead(encoded=encoded).eval()
        psf = torch.rand(1, 3, 5, 5, generator=torch.Generator().manual_seed(0))
        psf = 0.8 * psf / psf.sum((-2, -1), keepdim=True)
        one = torch.ones(1, 3)
        head.closed_form.set_psfs(PSFBank(psf, torch.zeros(1), one, 0.2 * one))
        image = 0.1 + 0.8 * (torch.arange(300) > 150).float().expand(1, 3, 40, -1)
        tile = 2 * receptive_field(head) + 20
        assert tile < 200
        difference, tiles, _ = seam(head, image, tile=tile)
        assert tiles > 1
        assert difference <= SEAM
        assert head.closed_form.mean_light is None

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("name", [name for name in HEADS if name != "corners"])
    def test_feature_the_networks_show_no_seam_in_float32(self, name):
        """Tiles differ from the whole by no more than twice what the whole is rounded by. No multiples of 16."""
        head, image = trained(name), torch.rand(1, 3, 29, 331)
        difference, tiles, _ = seam(head, image, tile=272)
        with torch.no_grad():
            rounded = maps_of(head(image.contiguous(memory_format=torch.channels_last)))
            exact = maps_of(head.double()(image.double()))
        head.float()
        rounding = max(float((a - b).abs().max()) for a, b in zip(rounded, exact, strict=True))
        assert tiles > 1
        assert rounding < 1e-4
        assert difference <= max(1e-6, 2 * rounding)

    def test_feature_a_margin_one_pixel_less_is_too_little(self):
        head = nn.Sequential(nn.Conv2d(3, 4, 5, padding=2), nn.Conv2d(4, 1, 3, padding=1)).eval()
        image = torch.rand(1, 3, 40, 50)
        assert seam(head, image, tile=20, overlap=3)[0] < 1e-6
        assert seam(head, image, tile=20, overlap=2)[0] > 1e-3

    @pytest.mark.parametrize(
        ("make", "margin"),
        [
            (lambda: head_of(small(), dtype=torch.float64, trained=True), None),
            pytest.param(lambda: any_camera(torch.float64, trained=True), None, marks=pytest.mark.takes_seconds),
            (lambda: head_of(None, dtype=torch.float64), 5 // 2 + 8 + 3),
            (lambda: JointHead(stirred(width=2, dtype=torch.float64)), 10 + 8 + 31 + 31),  # filters, patches, networks
            (lambda: refocused(AttentionUNet(7, 2, width=2).double(), torch.float64), None),
            (lambda: refocused(Shown(7, 7), torch.float64), 4),  # though they are applied by a transform of all
            pytest.param(lambda: joint_estimate(kind=NAFNet), None, marks=pytest.mark.takes_seconds),
            pytest.param(lambda: joint_estimate(kind=PlainHead), None, marks=pytest.mark.takes_seconds),
            pytest.param(lambda: joint_estimate(kind=PlainHead, refined=True), None, marks=pytest.mark.takes_seconds),
        ],
    )
    def test_feature_kernels_filters_and_networks_see_no_farther_than_the_margin(self, make, margin):
        """Classes of depth are averaged on a grid of 4 pixels, also behind a network without a grid of its own."""
        torch.manual_seed(0)
        head = make().eval()
        reach = receptive_field(head)
        assert margin in (None, reach)
        difference, tiles, _ = seam(head, photo(40, 2 * reach + 80)[:1], tile=(48, 2 * reach + 32))
        assert tiles > 1
        assert difference <= 1e-9


def joint_estimate(**options):
    return JointHead(joint(trained=True, dtype=torch.float64, **options))


class TestReconstructTiled(BaseTester):
    def test_cardinality_batches(self):
        image = torch.rand(3, 3, 60, 100)
        assert seam(trained("corners"), image, tile=48)[0] < 1e-6

    def test_feature_results_go_where_they_are_wanted(self, tmp_path):
        head, image = trained("corners"), torch.rand(1, 3, 70, 90)
        file = np.lib.format.open_memmap(tmp_path / "maps.npy", "w+", np.float32, (1, 2, 70, 90))
        given_back = reconstruct_tiled(head, image, tile=48, out=torch.from_numpy(file))
        file.flush()
        assert given_back.data_ptr() == file.ctypes.data
        with torch.no_grad():
            self.assert_close(torch.from_numpy(np.load(tmp_path / "maps.npy")), head(image), atol=1e-5)

    def test_feature_an_image_may_be_of_another_type_than_the_head(self):
        head, image = trained("corners"), torch.rand(1, 3, 30, 30)
        assert torch.equal(reconstruct_tiled(head, image.double()), reconstruct_tiled(head, image))

    def test_feature_progress_counts_to_the_end_and_can_stop(self):
        seen = []
        reconstruct_tiled(trained("plain"), torch.rand(1, 3, 150, 90), tile=80, progress=lambda *n: seen.append(n))
        assert seen == [(i + 1, len(seen)) for i in range(len(seen))]
        assert len(seen) > 3

        def stop(done, of):
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            reconstruct_tiled(trained("plain"), torch.rand(1, 3, 150, 90), tile=80, progress=stop)

    @pytest.mark.takes_seconds
    def test_feature_a_smaller_budget_takes_smaller_tiles_that_stay_within_it(self):
        head, image = trained("attention"), torch.rand(1, 3, 700, 900)
        grid = TileGrid((700, 900), 16, receptive_field(head))
        areas = []
        for budget in (64 << 20, 128 << 20, 256 << 20, 1 << 30):
            pixels = budget * 256**2 // head_bytes(head, torch.rand(1, 3, 256, 256))
            sides = grid.cheapest_sides(pixels)
            assert head_bytes(head, image[..., : sides[0], : sides[1]]) <= 1.01 * budget
            areas.append(sides[0] * sides[1])
        assert areas == sorted(areas)
        assert areas[0] < areas[-1] == 704 * 912

    def test_feature_an_image_that_fits_the_memory_is_seen_as_it_is(self):
        """By any network, whose receptive field is not measured: that of shipped ones takes half a minute."""
        seen = []

        class Centred(nn.Conv2d):
            def forward(self, image):
                seen.append(tuple(image.shape[-2:]))
                return image - image.mean()

        head, image = Centred(3, 3, 1).eval(), torch.rand(1, 3, 60, 90)
        self.assert_close(reconstruct_tiled(head, image), image - image.mean())
        assert seen == [(128, 128), (60, 90)]  # its memory is counted once
        reconstruct_tiled(shared_copy(head), image[..., :50])
        assert seen[2:] == [(60, 50)]
        with pytest.raises(ValueError, match="the head cannot be tiled"):
            reconstruct_tiled(head, image, memory_budget=10000)

    def test_feature_a_head_is_remembered_only_while_it_lives(self):
        head, image, seen, tiles = SmallUNet().eval(), torch.rand(1, 3, 50, 50), [], []
        reconstruct_tiled(head, image, tile=48)
        head.first.register_forward_hook(lambda *_: seen.append(1))
        reconstruct_tiled(head, image, tile=48, progress=lambda _, of: tiles.append(of))
        assert len(seen) == len(tiles)  # its reach was measured before
        alive = weakref.ref(head)
        del head
        assert alive() is None

    @pytest.mark.parametrize("far", [nn.InstanceNorm2d(3), nn.AdaptiveAvgPool2d(1)])
    def test_exception_a_head_that_looks_at_everything(self, far):
        class Global(nn.Module):
            def __init__(self):
                super().__init__()
                self.far = far

            def forward(self, image):
                return image - self.far(image)

        with pytest.raises(ValueError, match="cannot be tiled: each of its outputs depends on pixels more than"):
            reconstruct_tiled(Global().eval(), torch.rand(1, 3, 20, 20), tile=16)

    def test_exception_a_head_that_knows_the_place(self):
        class Vignette(nn.Module):
            def forward(self, image):
                return image * torch.linspace(0, 1, image.shape[-1], dtype=image.dtype)

        with pytest.raises(ValueError, match="cannot be tiled exactly: its output depends on where a pixel lies"):
            reconstruct_tiled(Vignette().eval(), torch.rand(1, 3, 20, 20), tile=16)
        assert reconstruct_tiled(Vignette().eval(), torch.rand(1, 3, 20, 20), overlap=4).shape == (1, 3, 20, 20)

    def test_exception_a_stride_that_is_not_declared(self):
        class Undeclared(nn.Module):
            def forward(self, image):
                small = nn.functional.max_pool2d(image, 4, ceil_mode=True)
                return nn.functional.interpolate(small, image.shape[-2:], mode="nearest")

        with pytest.raises(ValueError, match=r"borders are not those of a ReconstructionHead \(total stride 1\)"):
            reconstruct_tiled(Undeclared().eval(), torch.rand(1, 3, 20, 20), tile=16)

    def test_exception_training_mode(self):
        with pytest.raises(ValueError, match=r"must be in eval mode, not training: call head.eval\(\)"):
            reconstruct_tiled(SmallUNet(), torch.rand(1, 3, 20, 20))

    def test_exception_names_what_is_too_small(self):
        head, image = trained("attention"), torch.rand(1, 3, 600, 600)
        with pytest.raises(ValueError, match="at least 240 x 240 pixels for an overlap of 112 at each cut, got 200"):
            reconstruct_tiled(head, image, tile=200)
        with pytest.raises(ValueError, match="the smallest tile of this head, 240 x 240 pixels, takes 24 MiB, memory_"):
            reconstruct_tiled(head, image, memory_budget=1 << 20)
        with pytest.raises(ValueError, match="memory_budget must be positive"):
            reconstruct_tiled(head, image, memory_budget=0)
        with pytest.raises(ValueError, match="overlap must be 0 pixels or more, got -1"):
            reconstruct_tiled(head, image, overlap=-1)
        with pytest.raises(TypeError, match="image must be floating point"):
            reconstruct_tiled(head, torch.zeros(1, 3, 8, 8, dtype=torch.uint8))


class TestReceptiveField(BaseTester):
    @pytest.mark.parametrize("kernel", [1, 3, 7])
    @pytest.mark.parametrize("dilation", [1, 3])
    def test_feature_a_convolution_reaches_half_its_kernel(self, kernel, dilation):
        head = nn.Conv2d(3, 1, kernel, dilation=dilation, padding=dilation * (kernel // 2)).eval()
        assert receptive_field(head) == dilation * (kernel // 2)

    def test_feature_weights_that_are_zero_count(self):
        head = nn.Conv2d(3, 1, 9, padding=4).eval()
        nn.init.zeros_(head.weight)
        assert receptive_field(head) == 4

    def test_feature_one_sided_networks_are_seen_from_both_sides(self):
        class Right(nn.Module):
            def forward(self, image):
                return nn.functional.pad(image[..., 5:], (0, 5))

        assert receptive_field(Right().eval()) == 5


class TestTileGrid(BaseTester):
    @pytest.mark.takes_seconds
    @settings(max_examples=100)
    @given(
        st.integers(1, 300),
        st.integers(1, 300),
        st.sampled_from([1, 2, 16, 32]),
        st.integers(0, 40),
        st.integers(1, 10**5),
    )
    def test_property_every_pixel_is_kept_once_and_far_from_cuts(self, height, width, stride, overlap, pixels):
        grid = TileGrid((height, width), stride, overlap)
        sides = grid.cheapest_sides(pixels)
        if sides is None:
            least = grid.smallest_sides()
            assert least[0] * least[1] > pixels
            return
        assert sides[0] * sides[1] <= pixels
        image = torch.arange(height * width, dtype=torch.float64).view(1, 1, height, width)
        whole, times = torch.full_like(image, -1), torch.zeros_like(image)
        for place in grid.tiles(sides):
            for span, side, length in zip(place, sides, grid.whole, strict=True):
                assert span.start % stride == 0
                assert span.kept - span.start >= overlap or span.start == span.kept == 0
                assert span.start + side - span.end >= overlap or span.end == length
            part = grid.cut(image, place, sides)
            assert part.shape[-2:] == sides
            grid.keep(part, whole, place)
            once = torch.zeros_like(image)
            grid.keep(torch.ones_like(part), once, place)
            times += once
        assert torch.equal(whole, image)
        assert bool((times == 1).all())

    def test_feature_the_cheapest_tile_is_found(self):
        """Against trying all of them."""
        grid = TileGrid((640, 1000), 16, 50)
        sides = grid.cheapest_sides(300 * 300)

        def cost(s):
            return len(grid.tiles(s)) * s[0] * s[1]

        every = [(a, b) for a in range(144, 641, 16) for b in range(144, 1009, 16) if a * b <= 300 * 300]
        assert cost(sides) == min(map(cost, every))


class TestHeadBytes(BaseTester):
    def test_feature_a_chain_holds_two_neighbours(self):
        """The input, and both sides of the widest convolution, twice where a library may reorder them."""
        head = nn.Sequential(nn.Conv2d(3, 16, 1), nn.Conv2d(16, 8, 1), nn.Conv2d(8, 1, 1))
        image = torch.rand(1, 3, 10, 10)
        assert head_bytes(head, image) == 4 * 100 * (3 + 2 * (16 + 8))
        assert head_bytes(head, image.contiguous(memory_format=torch.channels_last)) == 4 * 100 * (3 + 16 + 8)
