"""Plan of a capture: the chosen fidelity with its predicted error, operations and memory."""

from __future__ import annotations

from dataclasses import dataclass

from kornia_tidy.fidelity import Fidelity


@dataclass(frozen=True)
class RenderPlan:
    """Chosen fidelity of a capture with its predicted error and cost; ``print`` shows it in words.

    Args:
        fidelity: the settings, for ``optics.with_fidelity(plan.fidelity)``. The window is fixed.
        reference: the preset that the error refers to, with the window of the current masks.
        tolerance: largest error allowed.
        predicted_error: root mean square difference of the noise-free linear capture to ``reference``, full scale 1:
            an upper estimate, see :mod:`kornia_tidy.planning.planner` for its assumptions.
        operations: of one capture with its PSFs, those of float64 counted twice.
        memory_bytes: peak of one capture without gradients, beyond the image.
        reference_operations: those of the reference.
        layers_present: PSFs computed for the scene.
        layers_total: those of the camera's whole range.
        states: number of states of the exposure that are rendered one by one; 1 except for occlusion.
        wavelengths: number of wavelengths computed for each layer.
        wavelengths_total: number of wavelengths of the camera's spectrum, all of which the reference uses.
        light_held: least and largest share of the light in the window, at the depths of the scene.
        reference_error: error of the reference from its layers, against the exact PSF of each pixel's depth.
        error_parts: contributions to ``predicted_error``, by name of the setting.
    """

    fidelity: Fidelity
    reference: Fidelity
    tolerance: float
    predicted_error: float
    operations: float
    memory_bytes: int
    reference_operations: float
    layers_present: int
    layers_total: int
    states: int
    wavelengths: int
    wavelengths_total: int
    light_held: tuple[float, float]
    reference_error: float
    error_parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        """Describe in words the computed and the skipped parts of the capture, and their cost."""
        knobs, full = self.fidelity, self.reference
        held = " to ".join(dict.fromkeys(f"{share:.0%}" for share in self.light_held))
        skipped = [f"{self.layers_total - self.layers_present} of the layers, at depths that the scene does not have"]
        reasons = {
            "layers": "PSFs between the layers",
            "window": f"light beyond {knobs.window} of {full.window} px",
            "wavelengths": f"{self.wavelengths_total - self.wavelengths} wavelengths, merged with their neighbours",
            "points a pixel": "finer integration over pixels",
            "float32": "float64",
        }
        skipped += [f"{reasons[name]} (error {error:.1e})" for name, error in self.error_parts if error > 0]
        every = f"{self.wavelengths} of {total}" if (total := self.wavelengths_total) > self.wavelengths else f"{total}"
        at = f", at all {total} wavelengths of the camera's spectrum" if total > self.wavelengths else ""
        return "\n".join(
            [
                f"{knobs.name}: error {self.predicted_error:.1e} of full scale against the reference"
                + (", as nothing cheaper is within the tolerance" if knobs.name == full.name else ""),
                f"  computes: {self.layers_present} of {self.layers_total} {knobs.layers} layers of defocus, for each "
                f"PSFs at {every} wavelength{'s' if total != 1 else ''} of {knobs.window}x"
                f"{knobs.window} px that hold {held} of the light, in float{64 if knobs.double else 32}"
                + (f", and an image for each of {self.states} states of the exposure" if self.states > 1 else ""),
                "  skips: " + "; ".join(skipped),
                f"  costs: {self.operations:.2g} operations, {self.operations / self.reference_operations:.2%} of the "
                f"reference's, and {self.memory_bytes / 2**20:.0f} MiB",
                f"  the reference itself is {self.reference_error:.1e} from a PSF of its own for each depth{at}",
            ]
        )
