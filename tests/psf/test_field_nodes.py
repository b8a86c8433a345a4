"""Tests of the promise of nodes over the field: PSFs between them within the tolerance."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, NoMask, PixelwiseMask
from kornia_tidy.optics import Lens
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester

CROPS = [((128, 128), (-490.0, -577.0)), ((256, 256), (-427.0, -513.0)), ((1110, 1282), (0.0, 0.0))]
PLACES = (-0.97, -0.55, 0.4, 0.8)  # within a crop, from -1 to 1


class TestFieldNodes(BaseTester):
    @pytest.mark.parametrize("name", ["single-50mm", "double-gauss-50mm"])
    @pytest.mark.parametrize("masks", [0, 1, 3])
    @torch.no_grad()
    def test_feature_psfs_between_nodes_keep_the_tolerance(self, name, masks):
        """At the ends of the range of defocus and at focus, of a lens without masks too."""
        lens = Lens.named(name, 17.6, 0.595)
        shown = PixelwiseMask(masks, generator=torch.Generator().manual_seed(1)) if masks else NoMask(23)
        model = PSFModel(shown, lens.camera(8e-6), fidelity=Fidelity(window=41), lens=lens)
        depths = sorted((0.0, *model.camera.defocus_range))
        for size, center in CROPS:
            field = model.field_of(size, center)
            (down, across), grid = ((side - 1) / 2 for side in size), [(y, x) for y in PLACES for x in PLACES]
            pixels = [(down * (1 + y), across * (1 + x)) for y, x in grid]
            places = [(center[0] + down * y, center[1] + across * x) for y, x in grid]
            nodes, exact = (model.psf_bank(1, defocus=depths, field=own) for own in (field.points, places))
            for index, pixel in enumerate(pixels):
                error = (nodes.between(field, pixel).psfs - exact.psfs[index]).flatten(1).norm(dim=1)
                assert float((error / exact.psfs[index].flatten(1).norm(dim=1)).max()) < model.fidelity.field_tolerance

    @torch.no_grad()
    def test_feature_psfs_taken_as_in_the_middle_of_a_tile_keep_the_tolerance(self):
        """At the corners of tiles as large as they may be, at the picture's corner and beside its middle."""
        lens = Lens.named("single-50mm", 17.6, 0.595)
        fidelity = Fidelity(window=41, field_tolerance=0.1)
        masks = PixelwiseMask(5, generator=torch.Generator().manual_seed(1))
        model, size = PSFModel(masks, lens.camera(8e-6), fidelity=fidelity, lens=lens), (1110, 1282)
        field, depths = model.field_of(size), sorted((0.0, *model.camera.defocus_range))
        assert 30 < field.still < 128
        nodes = model.psf_bank(1, defocus=depths, field=field.points)
        psfs = nodes.psfs.unflatten(0, field.nodes)
        errors = []
        for number in (0, 9):
            corner, values = [], psfs
            for axis in (1, 0):
                edges, _, weights = field.tiles(axis, 0, size[axis], field.still)
                assert not weights[:, 1].any()
                corner.append(float(edges[number]))
                values = torch.tensordot(weights[number, 0].to(psfs), values, ([0], [axis]))
            there = nodes.between(field, (corner[1], corner[0])).psfs
            errors.append(float(((values - there).flatten(1).norm(dim=1) / there.flatten(1).norm(dim=1)).max()))
        assert 0.01 < max(errors) < fidelity.field_tolerance
