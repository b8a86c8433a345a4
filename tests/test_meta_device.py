"""The meta device, whose tensors have a shape and no values: a shape comes out, or a sentence says what to do."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch

from kornia_tidy import NoMask, PSFBank, TiDyOptics, moving_capture
from kornia_tidy.data import write_depth, write_image
from kornia_tidy.lab.mask_export import write_heights
from tests.base import BaseTester
from tests.operations import OPERATIONS
from tests.test_kinds import argument, bound
from tests.test_modules import MADE

# One says what is missing, the other that two tensors are on two devices.
SENTENCES = "must hold values, and tensors on the meta device have none: move it|must be on the camera's device"
IMAGE, DEPTH = torch.rand(1, 3, 40, 40), torch.rand(1, 1, 40, 40) + 0.3
CAMERA = TiDyOptics()

CALLS: dict[str, Callable[[], Any]] = {
    "a camera that was moved": lambda: TiDyOptics().to("meta")(IMAGE.to("meta"), DEPTH.to("meta")),
    "behind a lens": lambda: under_meta(partial(TiDyOptics(NoMask(23), lens="single-50mm"), IMAGE, DEPTH)),
    "its PSFs": lambda: TiDyOptics().to("meta").psf_bank(),
    "its noise": lambda: CAMERA.draw(IMAGE.to("meta")),
    "a plan": lambda: CAMERA.plan(DEPTH.to("meta")),
    "moments": lambda: moving_capture(CAMERA, IMAGE.expand(2, 3, 40, 40).to("meta"), DEPTH.expand(2, 1, 40, 40)),
    "measured PSFs": lambda: PSFBank.from_measured(torch.rand(3, 3, 5, 5).to("meta"), torch.arange(3.0)),
    "an image file": lambda: write_image("unused.png", IMAGE[0].to("meta")),
    "a depth file": lambda: write_depth("unused.npy", DEPTH[0].to("meta")),
    "a mask file": lambda: write_heights("unused.npy", torch.zeros(1, 3, 3).to("meta")),
}


def shape_or_sentence(call: Callable[[], Any]) -> None:
    """Call what may refuse the device in one sentence, and raise nothing else."""
    try:
        call()
    except ValueError as error:
        refusal = str(error)
    else:
        return
    assert re.search(SENTENCES, refusal)
    assert "\n" not in refusal


def under_meta(call: Callable[[], Any]) -> Any:
    torch.set_default_device("meta")
    try:
        return call()
    finally:
        torch.set_default_device(None)


@pytest.fixture(autouse=True)
def _nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


class TestMetaDevice(BaseTester):
    @pytest.mark.parametrize("name", OPERATIONS)
    def test_exception_of_an_operation(self, name):
        given = argument(OPERATIONS[name])
        call = bound(OPERATIONS[name], given)
        shape_or_sentence(lambda: call(given.to("meta")))
        shape_or_sentence(lambda: under_meta(lambda: call(given)))

    @pytest.mark.parametrize("name", MADE)
    def test_exception_of_a_module(self, name):
        """Made there, made there and given memory, and moved there and printed."""
        shape_or_sentence(lambda: under_meta(MADE[name]))
        shape_or_sentence(lambda: under_meta(MADE[name]).to_empty(device="cpu"))
        shape_or_sentence(lambda: repr(MADE[name]().to("meta")))

    @pytest.mark.parametrize("name", CALLS)
    def test_exception_of_other_calls(self, name):
        shape_or_sentence(CALLS[name])

    def test_exception_names_the_remedy(self):
        with pytest.raises(ValueError, match=r"call torch.set_default_device\('cpu'\) if that is where"):
            under_meta(partial(TiDyOptics))
