"""Depth with holes through every adapter: the same pixels as filling by hand, and the mask of known pixels beside them.

``WAYS`` lists the adapters; each takes a scene with its depth as a reader of a sensor's files gives it, and moves it
before or after the picture is taken if it is a container.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import Any, NamedTuple

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

import kornia_tidy
from kornia_tidy import DefocusRange, TiDyOptics, burst, moving_capture
from kornia_tidy.augmentation import LinearCamera, OpticsPipeline, RandomDepthBlur, RandomTiDyOptics, bound_depth
from kornia_tidy.data import Scene, fill_holes
from tests.augmentation.optional import need, need_torchvision
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera

HEIGHT, WIDTH = 20, 28
CROP = (slice(4, 16), slice(4, 24))  # of 12 x 20 pixels in the middle
LENS: dict[str, Any] = {"focus_distance": (0.6, 0.6), "f_number": (4.0, 4.0), "focal_length": 10e-3, "p": 1.0}


# ------------------------------------------------------------------ depth as readers of five kinds of files give it


def slanted() -> NDArray[np.float32]:
    """A near object before a slanted wall, 0.5 to 2.4 m."""
    rows, columns = np.indices((HEIGHT, WIDTH))
    depth = 1.5 + 0.03 * columns + 0.005 * rows
    depth[6:16, 10:20] = 0.5 + 0.01 * rows[6:16, 10:20]
    return depth.astype(np.float32)


def kinect() -> NDArray[np.float32]:
    """0 at what does not reflect, and in the projector's shadow beside the near object."""
    depth = slanted()
    depth[5:17, 6:10], depth[0:3, 20:26] = 0, 0
    return depth


def middlebury() -> NDArray[np.float32]:
    """Disparity f B / z - doffs of which infinity is unknown and 0 is a sky; unknown depth is NaN."""
    disparity = 60 / slanted() - 20
    disparity[3:9, 18:24], disparity[:1] = np.inf, -20
    with np.errstate(divide="ignore"):
        return np.where(np.isinf(disparity), np.nan, 60 / (disparity + 20)).astype(np.float32)


def nyu() -> NDArray[np.float32]:
    """A frame without depth around the picture, and speckles."""
    depth = slanted()
    inside = np.zeros(depth.shape, bool)
    inside[2:-2, 2:-3] = np.random.default_rng(2).random((HEIGHT - 4, WIDTH - 5)) > 0.1
    return np.where(inside, depth, np.float32(0))


def lidar() -> NDArray[np.float32]:
    """Sparse returns of a laser at 5 % of the pixels; -1 elsewhere."""
    known = np.random.default_rng(3).permutation(HEIGHT * WIDTH) < HEIGHT * WIDTH // 20
    return np.where(known.reshape(HEIGHT, WIDTH), slanted(), np.float32(-1))


def one_pixel() -> NDArray[np.float32]:
    """Known in one pixel, which a crop to the middle keeps."""
    depth = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    depth[8, 9] = 0.8
    return depth


MAPS = {"Kinect": kinect, "Middlebury": middlebury, "NYU": nyu, "lidar": lidar, "one pixel": one_pixel}


def millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """The same map in 16 bits, as sensors store it: 0 is unknown, and what is too far is the largest number."""
    return np.rint(np.nan_to_num(depth, nan=0, posinf=65).clip(0, 65) * 1000).astype(np.uint16)


# ------------------------------------------------------------------ the adapters


class Taken(NamedTuple):
    """A picture of (3, H, W), and the mask of known pixels (H, W), if the form has a place for it."""

    image: Tensor
    valid: NDArray[np.bool_] | None = None


class Way(NamedTuple):
    """An adapter: takes the picture of an image (3, H, W) with its depth (H, W)."""

    take: Callable[[str, Tensor, Any, str], Taken]
    """Of ``holes``, image, depth as float32 or uint16, and when it is flipped and cropped: never, before or after."""
    needs: str = ""
    whole: bool = True
    """Whether it takes whole numbers with ``depth_scale``; else 16 bits are float16."""
    moves: tuple[str, ...] = ("never",)
    asks: str = r"depths? must be floating point .* convert it with depths?\.float\(\) \* 0\.001"
    """What whole numbers without a scale are told. Empty: kornia's containers make them floating point themselves."""


def scale_of(depth: Any) -> float | None:
    """Millimetres for uint16; int32 comes without a scale."""
    return 0.001 if np.asarray(depth).dtype == np.uint16 else None


def rows(image: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(image.permute(1, 2, 0).numpy())


def tensors(image: Tensor, depth: Any) -> tuple[Tensor, Tensor]:
    return image[None], torch.from_numpy(depth)[None, None]


def flags(valid: Any) -> NDArray[np.bool_]:
    return np.asarray(valid).reshape(np.asarray(valid).shape[-2:]) > 0


SCALE = "a depth of int32 needs depth_scale, metres per unit, such as 0.001 for millimetres"
PLAIN = camera(sensor=None)
OPTICS = {"error": PLAIN, "fill": camera(masks=PLAIN.masks, sensor=None, holes="fill")}


def through(call: Callable[[str, Tensor, Tensor], Tensor]) -> Way:
    """A call with a batch of one image and its depth that returns the picture alone."""
    return Way(lambda holes, image, depth, _: Taken(call(holes, *tensors(image, depth))[0]), whole=False)


def mapping(holes: str, image: Tensor, depth: Any, _: str) -> Taken:
    image, depth = tensors(image, depth)
    out = OPTICS[holes]({"image": image, "depth": depth})
    assert ("valid" in out) == (holes == "fill")
    return Taken(out["image"][0], flags(out["valid"]) if holes == "fill" else None)


def named_tuple(holes: str, image: Tensor, depth: Any, _: str) -> Taken:
    coded, depth, valid = OPTICS[holes](Scene(image, torch.from_numpy(depth)[None], None))
    assert valid is None or (depth > 0).all()
    return Taken(coded, None if valid is None else flags(valid))


def transform(kind: Callable[[Any], Any]) -> Way:
    """A transform of a data set, on a mapping with the image and the depth in a kind."""

    def take(holes: str, image: Tensor, depth: Any, _: str) -> Taken:
        out = PLAIN.as_transform(depth_scale=scale_of(depth), holes=holes)({"image": image, "depth": kind(depth)})
        assert type(out["depth"]) is type(kind(depth))
        return Taken(out["image"], flags(out["valid"]) if holes == "fill" else None)

    return Way(take, asks=SCALE)


def simulated(holes: str, image: Tensor, depth: Any, _: str) -> Taken:
    out = kornia_tidy.simulate(rows(image), depth, scale_of(depth), optics=PLAIN, color="rgb", holes=holes)
    return Taken(torch.from_numpy(out).permute(2, 0, 1))


def sequential(make: Callable[[str], Any]) -> Way:
    """An ``AugmentationSequential``: the depth comes out with its holes, moved with them."""

    def take(holes: str, image: Tensor, depth: Any, when: str) -> Taken:
        optics = make(holes)
        parts = [optics.depth_tap, optics]
        moves = [K.RandomHorizontalFlip(p=1.0), K.CenterCrop((12, 20))]
        parts = {"never": parts, "before": [*moves, *parts], "after": [*parts, *moves]}[when]
        coded, moved = K.AugmentationSequential(*parts, data_keys=["input", "mask"])(*tensors(image, depth))
        return Taken(coded[0], flags(fill_holes(moved)[1]))

    return Way(take, whole=False, moves=("never", "before", "after"), asks="")


def pipeline(holes: str, image: Tensor, depth: Any, when: str) -> Taken:
    geometry = None
    if when == "before":
        geometry = K.AugmentationSequential(K.RandomHorizontalFlip(p=1.0), K.CenterCrop((12, 20)), data_keys=None)
    out = OpticsPipeline(geometry, PLAIN, holes=holes)(
        dict(zip(("image", "depth"), tensors(image, depth), strict=True))
    )
    return Taken(out["image"][0], flags(out["valid"]) if holes == "fill" else None)


def bound(holes: str, image: Tensor, depth: Tensor) -> Tensor:
    chain = K.ImageSequential(RandomTiDyOptics(PLAIN, p=1.0, holes=holes))
    with bound_depth(chain, depth):
        return chain(image)


def of_deepinv(holes: str, image: Tensor, depth: Any, _: str) -> Taken:
    from kornia_tidy.augmentation.deepinv_physics import CameraPhysics

    image, depth = tensors(image, depth)
    physics = CameraPhysics(PLAIN, depth, holes)
    return Taken(physics(image)[0], None if physics.camera.valid is None else flags(physics.camera.valid))


def linear(holes: str, image: Tensor, depth: Any, _: str) -> Taken:
    image, depth = tensors(image, depth)
    linear = LinearCamera(PLAIN, depth, holes)
    return Taken(linear(image)[0], None if linear.valid is None else flags(linear.valid))


def torchvision(holes: str, image: Tensor, depth: Any, when: str) -> Taken:
    from torchvision import tv_tensors
    from torchvision.transforms import v2

    from kornia_tidy.augmentation.torchvision_v2 import Depth, OpticsTransform

    parts = [OpticsTransform(PLAIN, depth_scale=scale_of(depth), holes=holes)]
    moves = [v2.RandomHorizontalFlip(1.0), v2.CenterCrop((12, 20))]
    parts = {"never": parts, "before": [*moves, *parts], "after": [*parts, *moves]}[when]
    stored = torch.from_numpy(depth.astype(np.int32) if depth.dtype == np.uint16 else depth)  # torch flips no uint16
    out = v2.Compose(parts)({"image": tv_tensors.Image(image), "depth": Depth(stored[None])})
    assert ("valid" in out) == (holes == "fill")
    return Taken(out["image"].as_subclass(Tensor), flags(out["valid"]) if holes == "fill" else None)


def albumentations(holes: str, image: Tensor, depth: Any, when: str) -> Taken:
    import albumentations as A

    from kornia_tidy.augmentation.albumentations_v2 import OpticsTransform

    parts = [OpticsTransform(PLAIN, depth_scale=scale_of(depth), holes=holes)]
    moves = [A.HorizontalFlip(p=1.0), A.CenterCrop(12, 20)]
    parts = {"never": parts, "before": [*moves, *parts], "after": [*parts, *moves]}[when]
    out = A.Compose(parts, additional_targets={"depth": "mask", "valid": "mask"})(image=rows(image), depth=depth)
    assert ("valid" in out) == (holes == "fill")
    return Taken(torch.from_numpy(out["image"]).permute(2, 0, 1), flags(out["valid"]) if holes == "fill" else None)


WAYS = {
    "TiDyOptics": through(lambda holes, image, depth: OPTICS[holes](image, depth)),
    "TiDyOptics of a mapping": Way(mapping, whole=False),
    "TiDyOptics of a named tuple": Way(named_tuple, whole=False),
    "as_transform of arrays": transform(lambda depth: depth),
    "as_transform of tensors": transform(lambda depth: torch.from_numpy(depth)[None]),
    "as_transform of PIL images": transform(Image.fromarray),
    "as_transform of the camera's setting": through(
        lambda holes, image, depth: OPTICS[holes].as_transform()((image[0], depth[0]))[0][None]
    )._replace(asks=SCALE),
    "simulate": Way(simulated, asks=SCALE),
    "burst": through(lambda holes, image, depth: burst(OPTICS[holes], image, depth)[:, 0]),
    "moving_capture": through(
        lambda holes, image, depth: moving_capture(
            OPTICS[holes], *(x[:, None].expand(-1, 5, -1, -1, -1) for x in (image, depth))
        )
    ),
    "RandomTiDyOptics": through(lambda holes, *scene: RandomTiDyOptics(PLAIN, p=1.0, holes=holes)(*scene)),
    "RandomTiDyOptics of the camera's setting": through(
        lambda holes, *scene: RandomTiDyOptics(OPTICS[holes], p=1.0)(*scene)
    ),
    "RandomTiDyOptics in a container": sequential(lambda holes: RandomTiDyOptics(PLAIN, p=1.0, holes=holes)),
    "RandomTiDyOptics with a bound depth": through(bound),
    "RandomDepthBlur": through(lambda holes, *scene: RandomDepthBlur(**LENS, holes=holes)(*scene)),
    "RandomDepthBlur in a container": sequential(lambda holes: RandomDepthBlur(**LENS, holes=holes)),
    "OpticsPipeline": Way(pipeline, whole=False, moves=("never", "before")),
    "LinearCamera": Way(linear, whole=False),
    "deepinv": Way(of_deepinv, "deepinv", whole=False),
    "torchvision": Way(torchvision, "torchvision", moves=("never", "before", "after"), asks=SCALE),
    "albumentations": Way(albumentations, "albumentations", moves=("never", "before", "after"), asks=SCALE),
}


@pytest.fixture(params=WAYS)
def way(request) -> Way:
    found = WAYS[request.param]
    if found.needs:
        need(found.needs, module=False)
    if found.needs in {"torchvision", "deepinv"}:
        need_torchvision(module=False)
    return found


@pytest.fixture(autouse=True)
def _without_gradients():
    """PSFs are remembered from one capture to the next."""
    with torch.no_grad():
        yield


def moved(array: Any) -> Any:
    """Flipped and cropped to the middle, by hand."""
    if isinstance(array, Tensor):
        return array.flip(-1)[..., CROP[0], CROP[1]].contiguous()
    return np.ascontiguousarray(array[..., ::-1][..., CROP[0], CROP[1]])


def picture() -> Tensor:
    return torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))


def check(way: Way, depth: NDArray[Any], when: str) -> None:
    """A depth that is filled on the way gives what the depth filled by hand gives, and the mask of its holes."""
    seen, image = (moved(depth), moved(picture())) if when == "before" else (depth, picture())
    filled, known = fill_holes(seen)
    expected = way.take("error", image, filled, "never").image
    if when == "after":
        expected, known = moved(expected), moved(known)
    found = way.take("fill", picture(), depth, when)
    assert torch.equal(found.image, expected)
    if found.valid is not None:
        assert np.array_equal(found.valid, known)


def of_kind(way: Way, depth: NDArray[np.float32], kind: str) -> NDArray[Any]:
    if kind == "float":
        return depth
    return millimetres(depth) if way.whole else depth.astype(np.float16)


class TestDepthWithHoles(BaseTester):
    @pytest.mark.parametrize("kind", ["float", "16 bits"])
    def test_feature_every_adapter_fills_as_by_hand_and_tells_where(self, way, kind):
        for make, when in zip(MAPS.values(), cycle(way.moves), strict=False):
            check(way, of_kind(way, make(), kind), when)

    def test_exception_without_the_option_a_hole_is_refused(self, way):
        """With the line to type."""
        with pytest.raises(ValueError, match=r"fill holes with depth, valid = kornia_tidy\.data\.fill_holes\("):
            way.take("error", picture(), nyu(), "never")

    def test_exception_holes_alone_are_refused(self, way):
        with pytest.raises(ValueError, match="at one pixel or more, and map 0 of 1 holds 0, NaN or masked pixels"):
            way.take("fill", picture(), np.zeros((HEIGHT, WIDTH), np.float32), "never")

    def test_exception_whole_numbers_ask_for_their_scale(self, way):
        """Else millimetres were taken for metres."""
        if not way.asks:
            pytest.skip("the container makes masks floating point before the camera sees them")
        with pytest.raises((ValueError, TypeError), match=way.asks):
            way.take("error", picture(), millimetres(slanted()).astype(np.int32), "never")

    @pytest.mark.parametrize(
        "make",
        [
            TiDyOptics,
            RandomTiDyOptics,
            RandomDepthBlur,
            OpticsPipeline,
            PLAIN.as_transform,
            lambda holes: LinearCamera(PLAIN, torch.ones(1, 1, 9, 9), holes),
            lambda holes: kornia_tidy.simulate(rows(picture()), slanted(), optics=PLAIN, holes=holes),
        ],
    )
    def test_exception_other_words(self, make):
        with pytest.raises(ValueError, match="holes must be one of 'error', 'fill', got 'nearest'"):
            make(holes="nearest")

    def test_exception_a_disparity_of_zero_is_no_hole(self):
        optics, scene = camera(camera=DefocusRange()), tensors(picture(), slanted() / 3)
        filling = camera(camera=DefocusRange(), holes="fill")
        for take in (filling, filling.as_transform(), optics.as_transform(holes="fill"), OpticsPipeline(None, filling)):
            with pytest.raises(ValueError, match="to a DefocusRange 0 is the far end"):
                take(scene)
        with pytest.raises(ValueError, match="to a DefocusRange 0 is the far end"):
            RandomTiDyOptics(optics, p=1.0, holes="fill")(*scene)

    def test_feature_what_the_sample_says_is_not_valid_stays_so(self):
        image, depth = (x[0] for x in tensors(picture(), kinect()))
        left, top = (torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool) for _ in range(2))
        left[..., :3], top[:, :2] = False, False
        expected = left & top & (depth > 0)
        sample = {"image": image, "depth": depth, "mask": left, "valid": top}
        for take in (OPTICS["fill"], PLAIN.as_transform(holes="fill"), OpticsPipeline(None, OPTICS["fill"])):
            assert torch.equal(take(sample)["valid"], expected)
        with pytest.raises(ValueError, match=r"valid must have the depth's shape \(1, 20, 28\), got \(20, 28\)"):
            OPTICS["fill"]({**sample, "valid": top[0]})

    def test_feature_the_border_valid_crops_the_mask_too(self):
        optics = camera(sensor=None, border="valid", holes="fill")
        image, depth = (x[0] for x in tensors(picture(), kinect()))
        known = (depth > 0)[:, 4:-4, 4:-4]
        assert torch.equal(optics({"image": image, "depth": depth})["valid"], known)
        assert torch.equal(optics(Scene(image, depth, depth > 0)).valid, known)
        out = optics.as_transform()({"image": rows(image), "depth": kinect()})
        assert np.array_equal(out["valid"], known[0])

    def test_feature_masked_arrays_go_the_same_way(self):
        known, image = kinect() > 0, rows(picture())
        depth = np.ma.masked_array(np.where(known, kinect(), 77), ~known)
        for take in (
            lambda holes, depth: PLAIN.as_transform(holes=holes)((image, depth))[0],
            lambda holes, depth: kornia_tidy.simulate(image, depth, optics=PLAIN, color="rgb", holes=holes),
        ):
            assert np.array_equal(take("fill", depth), take("error", fill_holes(kinect())[0]))
            with pytest.raises(ValueError, match=r"got 0\.0: fill holes"):
                take("error", depth)

    def test_feature_gradients_are_those_of_the_depth_filled_by_hand(self):
        optics, (image, depth) = camera(sensor=None, holes="fill"), tensors(picture(), nyu())
        learnt = [optics.masks.phase, depth.requires_grad_()]
        with torch.enable_grad():
            found = torch.autograd.grad(optics(image, depth).square().sum(), learnt)
            optics.holes = "error"
            expected = torch.autograd.grad(optics(image, fill_holes(depth)[0]).square().sum(), learnt)
        for one, other in zip(found, expected, strict=True):
            assert torch.equal(one, other)
        assert (found[1][depth <= 0] == 0).all()

    def test_feature_a_setting_like_others(self):
        optics = camera(masks=PLAIN.masks, sensor=None, holes="fill")
        assert "holes of depth filled" in repr(optics)
        assert "holes" not in repr(PLAIN) + repr(PLAIN.as_transform())
        assert "holes='fill'" in repr(PLAIN.as_transform(holes="fill"))
        assert optics.with_fidelity("draft").holes == "fill"
        optics.load_state_dict(PLAIN.state_dict(), take_over=True)  # a state says nothing about them
        assert optics.holes == "fill"
