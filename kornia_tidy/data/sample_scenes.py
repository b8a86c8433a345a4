"""Two scenes with depth that come with the library: a table with things on it, and leaves."""

from __future__ import annotations

from pathlib import Path

from kornia.geometry.transform import resize

from kornia_tidy.checks import check_choice
from kornia_tidy.data.dead_leaves import check_arguments
from kornia_tidy.data.photographic_leaves import photographic_leaves
from kornia_tidy.data.rgbd import Scene, read_rgbd

FOLDER = Path(__file__).with_name("scenes")
SCENES = ("table", "leaves")
SCALE = 1e-4  # m; unit of the stored depth


def sample_scene(name: str = "table", height: int = 480) -> Scene:
    """Return a scene that comes with the library.

    Args:
        name: ``"table"``: balls, books and boxes in sunlight on a table in front of a wall, 0.4 to 3.2 m away;
            ``"leaves"``: flat shapes from 0.3 to 10 m, by :func:`~kornia_tidy.data.photographic_leaves`.
        height: rows in pixels; there are four thirds as many columns. The table has 480 rows, and other sizes are
            interpolated from them.

    Returns:
        The image, :math:`(3, H, W)` float32, sRGB-encoded in [0, 1]; the depth, :math:`(1, H, W)` float32, metres along
        the optical axis; and the mask of valid depth, True everywhere. Each call returns the same scene.

    Raises:
        ValueError: if no scene has that name, or the height is not a positive integer.

    Convention:
        Depths are not mixed: those of other sizes are those of the nearest pixels. The scenes are paintings, not
        photographs; ``docs/make_sample_scene.py`` painted the table.

    Example:
        >>> scene = sample_scene()
        >>> scene.image.shape, scene.depth.shape, bool((scene.depth > 0.3).all())
        (torch.Size([3, 480, 640]), torch.Size([1, 480, 640]), True)
    """
    check_choice("name of a sample scene", name, SCENES)
    check_arguments(height, 1, (0.3, 10.0), 1, 0)
    size = height, max(1, round(height * 4 / 3))
    if name == "leaves":
        image, depth = photographic_leaves(*size, seed=4)
        return Scene.whole(image, depth)
    image, depth, _ = read_rgbd(FOLDER / "table.png", FOLDER / "table_depth.png", scale=SCALE)
    if size != image.shape[1:]:
        image = resize(image, size, antialias=True).clamp(0, 1)
        depth = resize(depth, size, interpolation="nearest")
    return Scene.whole(image, depth)
