r"""Photon transfer: a camera's gain and read noise from the variance of its counts as a function of their level.

.. math:: \sigma^2(\mu) = \frac{\mu}{g} + \left( \frac{\sigma_r}{g} \right)^2 + \frac{1}{12}

Here μ is the level in counts above black, g the gain in electrons a count, σ_r the read noise in electrons, and 1/12
the rounding of the converter. A straight line gives g and σ_r. A single picture includes the sensor's fixed pattern,
which adds (p μ)².
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_part, check_positive
from kornia_tidy.files import error_prefix, parse_json, read_bytes, write_bytes
from kornia_tidy.lab.calibration.noise.transfer_curve import (
    CurvePoint,
    black_planes,
    spatial_points,
    temporal_points,
    tile_of,
)
from kornia_tidy.lab.raw.capture import RawCapture
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.settings import is_number

FORMAT = "kornia_tidy.photon_transfer/1"
ROUNDING = 1 / 12  # variance that rounding to whole counts adds
RESOLVED = 0.24  # counts squared; EMVA 1288: with less variance, rounding hides the read noise
SAME_LEVEL = 0.02  # captures whose levels differ by at most this fraction plus one count have the same exposure
SAME_WHITE = 0.01  # relative: readers correct the saturation count of a file by its brightest pixels
STRAIGHT = 0.99  # R² above which the curve is reported as a straight line
LEAST_POINTS, LEAST_POINTS_SINGLE = 3, 8  # a point from a single picture is less certain than one from flats
WORST_R_SQUARED, WORST_GAIN_ERROR = 0.9, 0.25  # a worse fit is refused
_BISQUARE = 4.685  # Tukey's constant: 95 % efficient for Gaussian noise


@dataclass(frozen=True)
class TransferLine:
    """Line fitted to the points of a photon-transfer curve.

    Attributes:
        gain: electrons a count.
        gain_error: standard uncertainty of the gain.
        read_noise: electrons at zero light, including the noise of the dark current.
        read_noise_error: standard uncertainty of the read noise; it exceeds the value if rounding hides the noise.
        fixed_pattern: standard deviation of the pixels' response as a fraction of the level; 0 for differences.
        r_squared: fraction of the points' variance that the line explains, after subtraction of the fixed pattern. It
            includes the points that the robust fit rejected.
        samples: degrees of freedom of all points.
    """

    gain: float
    gain_error: float
    read_noise: float
    read_noise_error: float
    fixed_pattern: float
    r_squared: float
    samples: int


@dataclass(frozen=True)
class PhotonTransfer:
    """A camera's noise at one ISO setting.

    Attributes:
        camera: name of the camera, empty if unknown.
        iso: ISO setting, None if unknown.
        method: ``"single"`` for one picture of any scene, ``"flats"`` for differences of captures.
        black: mean count without light, measured in dark frames if there were any, else from the file.
        white: count at saturation.
        line: line for all channels together, which share the converter.
        channels: line for each channel that has enough points.
        points: points of the curve.
    """

    camera: str
    iso: float | None
    method: str
    black: float
    white: float
    line: TransferLine
    channels: dict[str, TransferLine]
    points: tuple[CurvePoint, ...]

    @property
    def full_well(self) -> float:
        """Electrons at the count of saturation; at high ISO the pixel itself can hold more."""
        return self.line.gain * (self.white - self.black)

    @property
    def read_noise_resolved(self) -> bool:
        """Whether the read noise exceeds, by three standard errors, the least that the converter's steps resolve.

        Below that, dark captures carry no information, and the value at zero light is extrapolated from bright ones. It
        can be too large by chance, so its error is taken into account.
        """
        least = max(self.line.read_noise - 3 * self.line.read_noise_error, 0.0)
        return (least / self.line.gain) ** 2 + ROUNDING >= RESOLVED

    def check_taken_alike(self, raw: RawCapture, name: str) -> None:
        """Raise ``ValueError`` if a capture was taken by another camera or at another known gain.

        Args:
            raw: the capture.
            name: of its file, for the message.
        """
        told = [("by", self.camera, raw.info.camera), ("at ISO", _in_words(self.iso), _in_words(raw.info.iso))]
        if abs(self.white - raw.white) > SAME_WHITE * raw.white:
            told.append(("with a saturation count of", _in_words(self.white), _in_words(raw.white)))
        for what, here, there in told:
            if here and there and here != there:
                raise ValueError(f"the noise was measured {what} {here}, and {name} was taken {what} {there}")

    def sensor_noise(self) -> SensorNoise:
        """Return a sensor with this camera's noise, in units where full scale is the count of saturation.

        Example:
            >>> line = TransferLine(2.0, 0.01, 6.0, 0.1, 0.0, 0.999, 10000)
            >>> PhotonTransfer("", 100.0, "flats", 512.0, 4095.0, line, {}, ()).sensor_noise()
            SensorNoise(read noise 0.000837287 of full scale, full well 7166 electrons, 12 bits, clipped to [0, 1])
        """
        bits = min(max(round(math.log2(self.white - self.black + 1)), 1), 16)
        return SensorNoise(self.line.read_noise / self.full_well, full_well=self.full_well, bits=bits)

    def in_words(self) -> list[tuple[str, str]]:
        """Return the results as topics and texts."""
        line = self.line
        iso = "" if self.iso is None else f", ISO {self.iso:g}"
        single = self.method == "single"
        limit = "" if self.read_noise_resolved else " (no more than a guess: rounding to counts may hide it)"
        topics = [
            ("camera", (self.camera or "unknown") + iso),
            ("levels", f"black {self.black:g}, white {self.white:g}"),
            ("gain", f"{line.gain:.4g} ± {line.gain_error:.2g} electrons a count"),
            ("read", f"{line.read_noise:.4g} ± {line.read_noise_error:.2g} electrons{limit}"),
            ("white", f"stands for {self.full_well:.4g} electrons"),
        ]
        if single:
            pattern = f"{line.fixed_pattern:.2%} of the level" if line.fixed_pattern else "not seen"
            topics.append(("pattern", f"{pattern}; fixed pattern and fine texture cannot be told apart in one picture"))
        for name, own in self.channels.items():
            topics.append(
                (f"  {name}", f"gain {own.gain:.4g}, read noise {own.read_noise:.3g} electrons, R² {own.r_squared:.4f}")
            )
        straight = "a straight line" if line.r_squared >= STRAIGHT else f"below {STRAIGHT}: not quite a straight line"
        topics.append(("R²", f"{line.r_squared:.4f} over {len(self.points)} points, {straight}"))
        return topics


def photon_transfer(captures: Sequence[RawCapture], darks: Sequence[RawCapture] = ()) -> PhotonTransfer:
    """Measure a camera's gain and read noise by photon transfer.

    Args:
        captures: one picture of any scene with smooth areas of different brightness; or flats, two or more of each
            exposure, in any order. Flats may show any static scene, and may include dark captures.
        darks: captures without light at the same settings. Their mean replaces the file's black level, separately for
            each position of the filter array's tile. Two or more also give points of the curve.

    Returns:
        The calibration.

    Raises:
        ValueError: if captures are not of one camera, ISO and size, an exposure has no second capture, or the pictures
            do not allow a calibration because of texture, a single level, or a curve that is not straight.

    Convention:
        - Fixed pattern, scene and drift of the light cancel in flats. In a single picture the fixed pattern is fitted
          together with the line. Texture that is too fine or faint to be distinguished from noise makes the gain a few
          percent too small, which the stated error does not include.
        - Without ``darks`` an error of the file's black level remains undetected. A black level too high by one count
          lowers the read noise squared by the electrons of one count.
        - A read noise below 0.4 counts is uncertain, and its error is accordingly large.

    Source: Janesick, Photon Transfer, 2007; EMVA Standard 1288, 4.0.

    Example:
        >>> def flat(electrons):  # 2 electrons a count, read noise 6 electrons
        ...     n = torch.poisson(torch.full((1, 256, 256), electrons)) + 6 * torch.randn(1, 256, 256)
        ...     return RawCapture.from_counts((n / 2 + 512).round().int(), "RGGB", black=512, white=4095)
        >>> _ = torch.manual_seed(0)
        >>> result = photon_transfer([flat(e) for e in (0.0, 0.0, 900.0, 900.0, 5000.0, 5000.0)])
        >>> abs(result.line.gain - 2) < 0.06, abs(result.line.read_noise - 6) < 0.18
        (True, True)
    """
    if not captures:
        raise ValueError("a photon-transfer calibration needs one capture or more, got none")
    first = captures[0]
    _check_alike([*captures, *darks])
    black = _mean_black(darks) if darks else None
    single = len(captures) == 1
    if single:
        points = spatial_points(first, black)
    else:
        groups = _exposures(captures, black)
        points = [point for group in groups for point in temporal_points(group, black)]
    if len(darks) > 1:
        points += temporal_points(darks, black)
    line = fit_line(points, fixed_pattern=single)
    _check_line(line, single)
    channels = {}
    for name in dict.fromkeys(point.channel for point in points):
        own = [point for point in points if point.channel == name and point.variance >= RESOLVED]
        if (
            len(own) >= (LEAST_POINTS_SINGLE if single else LEAST_POINTS)
            and (fit := _fit(own, fixed_pattern=single)) is not None
        ):
            channels[name] = fit
    level = float(black_planes(first, black).mean())
    method = "single" if single else "flats"
    return PhotonTransfer(first.info.camera, first.info.iso, method, level, first.white, line, channels, tuple(points))


def fit_line(points: Sequence[CurvePoint], fixed_pattern: bool = False) -> TransferLine:
    """Fit the photon-transfer line by robust weighted least squares.

    Args:
        points: level, variance and degrees of freedom; three or more, eight with a fixed pattern.
        fixed_pattern: whether to fit a term quadratic in the level too, as a single picture needs. It is kept if it is
            significant by three standard errors.

    Returns:
        The line.

    Raises:
        ValueError: if there are fewer points, or variance does not grow with level.

    Convention:
        - Points of less than 0.24 counts squared are ignored, because rounding does not add 1/12 to them.
        - A weight is the inverse of the variance of the fitted value, var(s²) = 2 σ⁴ / samples, times Tukey's bisquare
          of the residual.
        - Uncertainties follow from the weights, or from the scatter about the line if that is larger.

    Example:
        >>> points = [CurvePoint("L", m, m / 2 + 9 + 1 / 12, 10**6) for m in (0.0, 100.0, 1000.0)]
        >>> line = fit_line(points)
        >>> round(line.gain, 6), round(line.read_noise, 6), line.r_squared
        (2.0, 6.0, 1.0)
    """
    clear = [point for point in points if point.variance >= RESOLVED]
    least = LEAST_POINTS_SINGLE if fixed_pattern else LEAST_POINTS
    if len(clear) < least:
        raise ValueError(
            f"the pictures do not allow a photon-transfer fit: {len(clear)} levels with measurable noise, {least} or "
            f"more are needed (smooth, unsaturated areas of different brightness)"
        )
    line = _fit(clear, fixed_pattern)
    if line is None:
        raise ValueError(
            "the pictures do not allow a photon-transfer fit: the variance of the counts does not grow with their "
            "level, so they are not linear raw counts, or all of one level"
        )
    return line


def write_json(path: str | os.PathLike[str], result: PhotonTransfer) -> None:
    """Write a calibration as a JSON file; after an error no partial file remains.

    Args:
        path: file to write; an existing one is replaced.
        result: the calibration.

    Raises:
        FileNotFoundError: if the folder does not exist.
    """
    document = {"format": FORMAT, **asdict(result)}
    write_bytes(path, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: str | os.PathLike[str]) -> PhotonTransfer:
    """Read a calibration from a JSON file written by :func:`write_json`.

    Args:
        path: file to read.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a calibration of this format.
    """
    data = read_bytes(path)
    with error_prefix(f"{path} is not a readable noise calibration", ArithmeticError, TypeError):
        document = parse_json(data)
        if not isinstance(document, dict) or document.pop("format", None) != FORMAT:
            raise ValueError(f"its format is not {FORMAT!r}")
        _check_names(PhotonTransfer, document)
        for name, kind in (("channels", dict), ("points", list), ("camera", str), ("method", str)):
            check_part(name, document[name], kind, {dict: "an object", list: "a list", str: "a text"}[kind])
        channels = {str(name): _numbers(TransferLine, line) for name, line in document.pop("channels").items()}
        points = tuple(_numbers(CurvePoint, point) for point in document.pop("points"))
        line = _numbers(TransferLine, document.pop("line"))
        for name in ("black", "white", "iso"):
            if not (is_number(value := document[name]) and math.isfinite(value)) and (name, value) != ("iso", None):
                raise ValueError(f"{name} must be a finite number, got {value!r:.80}")
        result = PhotonTransfer(line=line, channels=channels, points=points, **document)
        if not result.white > result.black:
            raise ValueError(f"white must be above black, got {result.white:g} and {result.black:g}")
        check_positive("gain", line.gain, "electrons a count")
        result.sensor_noise()
    return result


def _in_words(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


# ---------------------------------------------------------------------- the fit


def _fit(points: Sequence[CurvePoint], fixed_pattern: bool) -> TransferLine | None:
    """Return the line, or None if variance does not grow with level by three standard errors."""
    level = torch.tensor([point.level for point in points], dtype=torch.float64)
    variance = torch.tensor([point.variance for point in points], dtype=torch.float64)
    samples = torch.tensor([point.samples for point in points], dtype=torch.float64)
    scale = max(float(level.abs().max()), 1e-9)  # gives all columns of the design the same magnitude
    if float(level.max() - level.min()) < 1e-3 * scale:
        return None
    powers = torch.stack([torch.ones_like(level), level / scale, (level / scale) ** 2], dim=-1)
    use = 3 if fixed_pattern else 2
    terms, covariance = _robust(powers[:, :use], variance, samples)
    if use == 3 and terms[2] < 3 * covariance[2, 2].sqrt():
        terms, covariance = _robust(powers[:, :2], variance, samples)
    slope, slope_error = float(terms[1]) / scale, float(covariance[1, 1].sqrt()) / scale
    if not slope > 3 * slope_error:
        return None
    pattern = float(terms[2]) / scale**2 if len(terms) == 3 else 0.0
    gain = 1 / slope
    straight = variance - pattern * level**2
    residual = (straight - terms[0] - slope * level).square().sum()
    total = (straight - straight.mean()).square().sum()
    read = (float(terms[0]) - ROUNDING) * gain**2  # read noise squared in electrons: (intercept - rounding) / slope²
    gradient = torch.tensor([gain**2, -2 * read * gain / scale], dtype=torch.float64)
    read_error = float((gradient @ covariance[:2, :2] @ gradient).sqrt())
    noise = math.sqrt(max(read, 0.0))
    return TransferLine(
        gain,
        slope_error * gain**2,
        noise,
        math.sqrt(noise**2 + read_error) - noise if noise**2 < read_error else read_error / (2 * noise),
        math.sqrt(pattern),
        float(1 - residual / total),
        int(samples.sum()),
    )


def _robust(design: Tensor, values: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
    """Return coefficients and their covariance by iteratively reweighted least squares."""
    fitted = values
    trust = torch.ones_like(values)
    terms, normal, scatter = design.new_zeros(design.shape[1]), torch.eye(design.shape[1]).to(design), 1.0
    for step in range(50):
        error = fitted * (2 / samples).sqrt()
        weight = trust / error.square()
        normal = design.T @ (weight[:, None] * design)
        terms = torch.linalg.lstsq(normal, design.T @ (weight * values)).solution
        fitted = (design @ terms).clamp(min=ROUNDING)  # an early step may give negative variances
        off = (values - design @ terms) / (fitted * (2 / samples).sqrt())
        scatter = max(1.0, 1.4826 * float(off.abs().median()))
        if step > 3:  # the first weights come from a poor fit
            before, trust = trust, (1 - (off / (_BISQUARE * scatter)).square()).clamp(min=0).square()
            if torch.allclose(before, trust, rtol=0, atol=1e-7):
                break
    return terms, torch.linalg.pinv(normal) * scatter**2


# ---------------------------------------------------------------------- captures


def _check_alike(captures: Sequence[RawCapture]) -> None:
    """Raise if the captures differ in camera, ISO, size, filter array or white level."""
    first = captures[0]
    kinds: dict[str, Any] = {
        "camera": lambda raw: raw.info.camera,
        "ISO": lambda raw: raw.info.iso,
        "size": lambda raw: tuple(raw.counts.shape),
        "pattern": lambda raw: raw.pattern,
        "white level": lambda raw: raw.white,
    }
    for raw in captures[1:]:
        for name, value in kinds.items():
            if value(raw) != value(first):
                raise ValueError(f"captures must be of one {name}, got {value(first)} and {value(raw)}")


def _check_line(line: TransferLine, single: bool) -> None:
    kind = "picture does" if single else "pictures do"
    if line.gain_error > WORST_GAIN_ERROR * line.gain:
        raise ValueError(
            f"the {kind} not allow a photon-transfer fit: the gain would be {line.gain:.3g} ± {line.gain_error:.2g} "
            f"electrons a count"
        )
    if line.r_squared < WORST_R_SQUARED:
        raise ValueError(
            f"the {kind} not allow a photon-transfer fit: variance over level is no straight line, R² is "
            f"{line.r_squared:.2f} (the counts were processed, or texture is everywhere)"
        )


def _mean_black(darks: Sequence[RawCapture]) -> Tensor:
    """Return the mean count at each position of the tile, or of each channel, in the shape of ``RawCapture.black``."""
    first = darks[0]
    rows, columns = tile_of(first)
    counts = torch.stack([raw.counts.double().mean(0, keepdim=first.counts.shape[0] == 1) for raw in darks]).mean(0)
    if first.pattern is None:
        return torch.stack([raw.counts.double().mean((-2, -1)) for raw in darks]).mean(0)
    return torch.stack([counts[0, i::rows, j::columns].mean() for i in range(rows) for j in range(columns)]).reshape(
        rows, columns
    )


def _exposures(captures: Sequence[RawCapture], black: Tensor | None) -> list[list[RawCapture]]:
    """Group captures by their mean level, and raise if a group has only one."""
    zero = float(black_planes(captures[0], black).mean())
    leveled = sorted(((float(raw.counts.double().mean()) - zero, raw) for raw in captures), key=lambda pair: pair[0])
    groups: list[list[RawCapture]] = []
    for k, (level, raw) in enumerate(leveled):
        if not k or level - leveled[k - 1][0] > SAME_LEVEL * level + 1:
            groups.append([])
        groups[-1].append(raw)
    if alone := [group[0] for group in groups if len(group) < 2]:
        lonely = float(alone[0].counts.double().mean()) - zero
        raise ValueError(
            f"every exposure needs two captures or more, the one with a mean of {lonely:.4g} counts over black has "
            f"no other within {SAME_LEVEL:.0%}"
        )
    return groups


def _check_names(kind: Any, entry: Any) -> None:
    """Raise ``ValueError`` unless an entry of JSON has the names of a dataclass."""
    names = {part.name for part in fields(kind)}
    if not isinstance(entry, dict):
        raise ValueError(f"it must hold {', '.join(sorted(names))}, got {entry!r:.80}")
    for name in sorted(names ^ set(entry)):
        told = "is missing" if name in names else "is none of them"
        raise ValueError(f"it must hold {', '.join(sorted(names))}, and {name:.80} {told}")


def _numbers(kind: type, entry: Any) -> Any:
    """Convert a JSON object to a dataclass, and raise if a field other than the channel's name is not a number."""
    _check_names(kind, entry)
    for name, value in entry.items():
        if name != "channel" and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise ValueError(f"{name:.80} must be a number, got {value!r:.80}")
    return kind(**entry)
