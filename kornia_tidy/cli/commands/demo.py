"""`kornia-tidy demo`: demonstration of capture and reconstruction beside a stopped-down lens, as two pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from kornia_tidy.choices import MASK_FAMILIES
from kornia_tidy.cli.commands.shared import Folder, OwnScene
from kornia_tidy.design.settings import DesignSettings
from kornia_tidy.files import output_folder
from kornia_tidy.settings import FNumber, Seed, Unit, one_of

if TYPE_CHECKING:
    from torch import Tensor

    from kornia_tidy.data.rgbd import Scene
    from kornia_tidy.design.compared_cameras import Camera, Result
    from kornia_tidy.optics.thin_lens import ThinLensCamera

LARGEST = 1024  # pixels of the longer side; larger pictures are made smaller, to keep a demonstration short


@dataclass(frozen=True, kw_only=True)
class Demo:
    """From a scene to captures and back, with and without masks, as two pages.

    A scene is photographed with phase masks in a wide aperture, and with a lens without
    masks that is stopped down: the same exposure time and the same light. Both captures are
    restored in closed form and, where a trained network is shipped for the camera, by the
    network. A third camera estimates the depth of every pixel. All scores are on the page.
    Masks, family or f-number make up another camera. The network any-camera restores its
    captures without training.
    The depths of your own scene are stretched, in dioptres, over the range for which the
    masks were made.

    Args:
        output: made if missing.
        electrons: of a white pixel at f/17.6; less is dimmer light.
        masks: number of random masks of a camera that is made up. None: 5, if one is made up.
        family: of its masks. None: pixelwise, if one is made up.
        f_number: of its lens. None: 17.6, if one is made up.
        size: side of the scene made here.
        seed: of scene and noise.
        scene: to be photographed.

    Examples:
        kornia-tidy demo
        kornia-tidy demo --electrons 500                                      dim light
        kornia-tidy demo --masks 3 --family spiral --f-number 12              a camera made up here
        kornia-tidy demo --image photo.png --depth depth.png --depth-scale 0.001
    """

    output: Folder = "outputs"
    electrons: Annotated[float, Unit("E", "electrons", 0, above=True)] = DesignSettings.electrons
    masks: Annotated[int, Unit("K", "", 1, 64)] | None = None
    family: Annotated[str, one_of(MASK_FAMILIES)] | None = None
    f_number: FNumber | None = None
    size: Annotated[int, Unit("PX", "pixels", 32)] = 512
    seed: Seed = 5  # of a scene of many kinds of texture
    scene: OwnScene = field(default_factory=OwnScene)

    def run(self) -> None:
        """Simulate captures, restore them, and write the two pages."""
        folder = output_folder(self.output)
        import torch

        from kornia_tidy.cli.commands.report import clamped_in_words, progress_bar, scene_in_words, tell
        from kornia_tidy.design.compared_cameras import photograph, stopped_down
        from kornia_tidy.figures.demonstration import (
            comparison_page,
            explained_page,
            light_in_words,
            pictures_of,
            scores_in_words,
            verdict_in_words,
        )
        from kornia_tidy.figures.style import require_matplotlib
        from kornia_tidy.optics.thin_lens import ThinLensCamera
        from kornia_tidy.reconstruction.tasks import normalised_inverse_depth

        require_matplotlib()
        with torch.no_grad(), progress_bar("demo", total=5) as progress:
            cameras = self._cameras()
            lens = cameras["coded"].optics.camera
            assert isinstance(lens, ThinLensCamera)  # as in the training of the systems
            scene = self._scene(lens)
            near = normalised_inverse_depth(lens, scene.depth)
            progress.update()
            if "flat" not in cameras:
                cameras["flat"] = stopped_down(lens, self.electrons)
            progress.update()
            results: dict[str, Result] = {}
            for name in ("coded", "flat", "joint"):
                if name in cameras:
                    results[name] = photograph(cameras[name], scene, self.seed)
                progress.update()
            pages = {
                "demo.png": explained_page(cameras["coded"], scene, results["coded"], self.seed),
                "reconstruction.png": comparison_page(cameras, results, scene, near, self.electrons),
            }
        pictures = pictures_of(results, scene, near)
        _write(folder, pictures, pages)

        tell("scene", scene_in_words(scene))
        tell("light", light_in_words(cameras, self.electrons))
        tell("clamped", clamped_in_words(cameras["coded"].optics, scene.depth))
        for name, result in results.items():
            tell(name, scores_in_words(cameras[name], result, scene, near))
        tell("verdict", verdict_in_words(results, scene))
        tell("wrote", f"{folder / 'reconstruction.png'}: read this one first")
        tell("", f"{folder / 'demo.png'}: how the masks make a capture")
        for name in pictures:
            tell("", str(folder / name))

    def _cameras(self) -> dict[str, Camera]:
        """Return the shipped cameras, or the one that is made up in place of that with masks."""
        from kornia_tidy.design.compared_cameras import REFERENCE_F_NUMBER, made_up_camera, shipped_cameras

        cameras = shipped_cameras(self.electrons)
        if (self.masks, self.family, self.f_number) != (None, None, None):
            family, masks, f_number = self.family or "pixelwise", self.masks or 5, self.f_number or REFERENCE_F_NUMBER
            cameras["coded"] = made_up_camera(family, masks, f_number, self.electrons, self.seed)
        return cameras

    def _scene(self, camera: ThinLensCamera) -> Scene:
        """Return a colour scene with depths stretched over the camera's range."""
        from kornia_tidy.data.photographic_leaves import PhotographicLeaves
        from kornia_tidy.reconstruction.tasks import stretched

        own = self.scene.read()
        if own is None:
            return PhotographicLeaves(1, self.size, self.size, depth_range=camera.depth_range, seed=self.seed).read(0)
        own = own.within(LARGEST)
        return own._replace(depth=stretched(own.depth, own.valid, camera))


def _write(folder: Path, pictures: Mapping[str, Tensor], pages: Mapping[str, bytes]) -> None:
    from kornia_tidy.data.image_files import write_image
    from kornia_tidy.files import write_bytes

    folder.mkdir(parents=True, exist_ok=True)
    for name, image in pictures.items():
        write_image(folder / name, image.clamp(0, 1))
    for name, content in pages.items():
        write_bytes(folder / name, content)
