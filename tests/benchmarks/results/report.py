"""Report: the page of tables in Markdown, and all scores by scene as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence

from tests.benchmarks.results.captures import FIXED, PHYSICAL
from tests.benchmarks.results.measure import BEST_RAMP, NO_CAMERA, NO_NOISE
from tests.benchmarks.results.restorations import NETWORK
from tests.benchmarks.results.scores import CONTRAST
from tests.benchmarks.results.store import Measured, Provenance
from tests.benchmarks.results.table import Difference, Key, Results
from tests.benchmarks.results.verdicts import FIVE, in_words, verdicts

IMAGE_SCORES = {"psnr": ("PSNR, dB", 2), "ssim": ("SSIM", 3), "chroma": ("chroma PSNR, dB", 2), "lpips": ("LPIPS", 3)}
DEPTH_SCORES = {
    "depth": "RMSE",
    "depth_textured": "textured",
    "depth_textureless": "textureless",
    "depth_bias_textureless": "bias where textureless",
}
SET_NAMES = {"real": "Real scenes", "leaves": "Dead leaves"}
PICTURE = "images/results.png"
INTRODUCTION = """\
# Results

This page compares optical systems and restorations on the same scenes. `python -m tests.benchmarks.results` measures
this page, and goes on where it was interrupted.

- **Scenes.** The 35 real scenes of `../shared/data`, the middle 512 pixels, depths stretched in dioptres over the
  camera's range; and 32 dead leaves of 256 pixels. No system was trained on any of them.
- **Halves.** A fixed seed splits each set. Settings are chosen on half A by the mean PSNR. All numbers are those of
  half B. Its 17 real scenes are not all independent: five show one room (open3d-redwood) and two another (icl-nuim),
  so that the standard errors are too small.
- **Captures.** PSFs of 129 pixels, the light outside them as an even background, gather, linear light. A fixed noise
  is a standard deviation in parts of full scale; at the same fixed noise a smaller aperture is exposed for longer.
  Electrons are those of a white pixel at f/17.6; other f-numbers have the same exposure time, shot noise and 2.4
  electrons of read noise. All systems get the same random numbers.
- **Restorations** take the capture, the camera's PSFs and the noise level. *Capture* is the unrestored capture.
  *Tikhonov* inverts the mean PSF of all depths with one weight for all frequencies, in linear light, towards the
  capture; *by estimated depth* it inverts the PSFs of 11 depths, blended by the depth that the network estimates.
  *Wiener* weighs frequencies by the mean PSF, the noise and the power spectrum of photographs; the factor is that of
  the noise's power. *Bilateral* is OpenCV's filter on the result, 7 pixels wide. *Network* is the network trained
  with the camera; *in 8 orientations* is the mean of its results for the turned and mirrored capture.
- **Scores** are those of sRGB images clipped to [0, 1]. Chroma PSNR is that of Cb and Cr. ± is the standard error of
  the mean of differences, taken scene by scene.
- **Systems.** `edof-5` has five masks, `edof-1` one. `joint` systems also estimate depth. *Flat* is a lens without
  masks at its f-number. *Preset* is a published camera with its masks as before training.
"""


def page(results: Results, cells: Sequence[Measured], recommended: Mapping[str, str] | None = None) -> str:
    """Return the whole page."""
    lines = [INTRODUCTION, _measured_where(cells), "", *_missing(results, cells), ""]
    lines += [f"![PSNR over noise and over f-number]({PICTURE})", "", "## Targets", ""]
    lines += ["On half B of the real scenes; targets are in dB unless another unit is given.", ""]
    lines += [*in_words(verdicts(results, recommended)), ""]
    for scenes in results.sets:
        title = SET_NAMES.get(scenes, scenes)
        for noise in (*FIXED, *PHYSICAL):
            if rows := results.keys(scenes, noise):
                lines += [f"## {title}, {_noise_in_words(noise)}", "", *_image_table(results, rows), ""]
        if depths := list(_depth_table(results, scenes)):
            lines += [f"## {title}, depth", "", *_depth_caption(), "", *depths, ""]
    return "\n".join(lines).rstrip() + "\n"


def scores_csv(results: Results) -> str:
    """Return one line for each scene and row, with the chosen settings."""
    text = io.StringIO()
    names = [*IMAGE_SCORES, *DEPTH_SCORES]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scenes", "half", "scene", "noise", "system", "optics", "restoration", "settings", *names])
    for key, by_scene in sorted(results.rows.items()):
        scenes = results.sets[key.scenes]
        for half, members in (("A", scenes.half_a), ("B", scenes.half_b)):
            for scene in members:
                about = [key.scenes, half, scene, key.noise, key.system, results.systems[key.system].title]
                values = [f"{value:.6g}" if (value := by_scene[scene].get(n)) is not None else "" for n in names]
                writer.writerow([*about, key.restoration, results.settings[key], *values])
    return text.getvalue()


def reference_row(results: Results, scenes: str, noise: str) -> Key | None:
    """Return the reference of the differences.

    It is the best closed form of five masks, or of all systems without them, or the best network without closed forms.
    """
    own = results.keys(scenes, noise, system=FIVE, network=False)
    return results.best(own or results.keys(scenes, noise, network=False) or results.keys(scenes, noise))


def _image_table(results: Results, rows: Sequence[Key]) -> Iterator[str]:
    """Rows of one set and noise from the best to the worst, with differences to the reference."""
    reference = reference_row(results, rows[0].scenes, rows[0].noise)
    assert reference is not None
    present = [name for name in IMAGE_SCORES if results.values(rows[0], name)]
    yield f"Δ is the difference to *{reference.restoration}* of `{reference.system}`."
    yield ""
    heads = [IMAGE_SCORES[name][0] for name in present]
    columns = ["system", "optics", "restoration", "settings", *heads, *(f"Δ {head}" for head in heads), "scenes ahead"]
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    for key in sorted(rows, key=lambda key: -results.mean(key, "psnr")):
        means = [f"{results.mean(key, name):.{IMAGE_SCORES[name][1]}f}" for name in present]
        gains = {name: results.difference(key, reference, name) for name in present}
        words = ["" if key == reference else _signed(gains[name], IMAGE_SCORES[name][1]) for name in present]
        ahead = "" if key == reference else f"{gains['psnr'].ahead} of {gains['psnr'].pairs}"
        about = [f"`{key.system}`", results.systems[key.system].title, key.restoration, results.settings[key]]
        yield f"| {' | '.join([*about, *means, *words, ahead])} |"


def _depth_caption() -> list[str]:
    return [
        "Inverse depth, 0 at the far and 1 at the near end of the camera's range: RMSE in parts of this range, over",
        f"pixels of known depth. Textured pixels have a local contrast of {CONTRAST:g} or more, the standard deviation",
        "of the luma in 9 x 9 pixels. Δ is the difference to the best ramp, a vertical ramp fitted to the true depth",
        "of each scene. The ramp of half A is one for all scenes.",
    ]


def _depth_table(results: Results, scenes: str) -> Iterator[str]:
    reference = Key(scenes, NO_NOISE, NO_CAMERA, BEST_RAMP)
    rows = [key for key in results.rows if key.scenes == scenes and results.values(key, "depth")]
    if not any(key.system != NO_CAMERA for key in rows):
        return
    columns = ["system", "estimate", "noise", *DEPTH_SCORES.values(), "Δ RMSE", "Δ textured"]
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    for key in sorted(rows, key=lambda key: (key.noise != NO_NOISE, key.noise, results.mean(key, "depth"))):
        means = [f"{results.mean(key, name):.3f}" for name in DEPTH_SCORES]
        words = ["", ""] if key == reference else [
            _signed(results.difference(key, reference, name), 3) for name in ("depth", "depth_textured")
        ]  # fmt: skip
        about = [key.system, key.restoration, "" if key.noise == NO_NOISE else _noise_in_words(key.noise)]
        yield f"| {' | '.join([*about, *means, *words])} |"


def _signed(difference: Difference, digits: int) -> str:
    return difference.rounded(digits) if difference.pairs else ""


def _noise_in_words(noise: str) -> str:
    return f"{int(noise[:-1]):,} electrons" if noise.endswith("e") else f"noise {noise}"


def _measured_where(cells: Sequence[Measured]) -> str:
    days, commits, machines = (
        sorted({getattr(cell.provenance, name) for cell in cells}) for name in Provenance._fields
    )
    span = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    return f"Measured {span} at commit{'s' * (len(commits) > 1)} {', '.join(commits)}: {'; '.join(machines)}."


def _missing(results: Results, cells: Sequence[Measured]) -> list[str]:
    """Return sentences on parts of the protocol without measurements."""
    lines = []
    if not any("lpips" in cell.scores for cell in cells):
        lines.append("LPIPS was not measured: its weights are not on this machine.")
    noises = [noise for noise in (*FIXED, *PHYSICAL) if not any(key.noise == noise for key in results.rows)]
    if noises:
        lines.append(f"Not measured yet: {', '.join(map(_noise_in_words, noises))}.")
    measured = {key.scenes for key in results.rows if key.system != NO_CAMERA}
    lines += [f"{title}: not measured yet." for name, title in SET_NAMES.items() if name not in measured]
    incomplete = sorted({cell.cell.system for cell in cells} - {key.system for key in results.rows})
    if incomplete:
        lines.append(f"Interrupted before they were complete: {', '.join(incomplete)}.")
    if not any(math.isfinite(results.mean(key, "psnr")) for key in results.rows if key.restoration == NETWORK):
        lines.append("No network was measured.")
    return lines
