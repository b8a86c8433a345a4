"""Plan of a capture: the chosen fidelity with its predicted error, operations and memory."""

from __future__ import annotations

from dataclasses import dataclass

from kornia_tidy.fidelity import Fidelity


@dataclass(frozen=True)
class RenderPlan:
    """Chosen fidelity of a capture with its predicted error and cost; ``print`` shows it in words.

    Args:
        fidelity: the settings, for ``optics.with_fidelity(plan.fidelity)``. The window is fixed, but for rays.
        reference: of the error: the preset ``reference``, with the window of the current masks.
        tolerance: largest error allowed.
        error_parts: contributions to :attr:`predicted_error`, by the name of the approximation.
        operations: of one capture with its PSFs, those of float64 counted twice.
        reference_operations: those of the reference.
        memory_bytes: peak of one capture without gradients, beyond the image.
        layers: PSFs computed for the scene, and those of the camera's whole range.
        window: side of the largest PSF in pixels.
        wavelengths: computed for each layer, and those of the camera's spectrum, which the reference uses.
        states: number of states of the exposure that are rendered one by one; 1 except for occlusion.
        field: places along the picture's height and width at which PSFs are computed.
        left_out: what the camera's ideal lens leaves out, in words; empty where it does not show.
    """

    fidelity: Fidelity
    reference: Fidelity
    tolerance: float
    error_parts: tuple[tuple[str, float], ...]
    operations: float
    reference_operations: float
    memory_bytes: int
    layers: tuple[int, int]
    window: int
    wavelengths: tuple[int, int]
    states: int = 1
    field: tuple[int, int] = (1, 1)
    left_out: str = ""

    @property
    def predicted_error(self) -> float:
        """Root mean square difference of the noise-free linear capture to ``reference``, full scale 1.

        It is an upper estimate, see :mod:`kornia_tidy.accuracy.planning.planner` for its assumptions.
        """
        return sum(error for _, error in self.error_parts)

    def __str__(self) -> str:
        """Describe the computation, its approximations and its cost in words."""
        first = f"{self.fidelity.name}: error {self.predicted_error:.1e} of full scale against {self.reference.name}"
        if self.predicted_error > self.tolerance:
            first += f", above the tolerance of {self.tolerance:g}"
        elif self.fidelity == self.reference:
            first += ", as nothing cheaper is within the tolerance"
        states = f", an image for each of {self.states} states of the exposure" if self.states > 1 else ""
        places = "" if self.field == (1, 1) else f", at {self.field[0]}x{self.field[1]} places over the picture"
        parts = [f"{name} (error {error:.1e})" for name, error in self.error_parts if error > 0]
        lines = [f"  leaves out: {self.left_out}"] if self.left_out else []
        return "\n".join(
            [
                first,
                f"  computes: {self.layers[0]} of {self.layers[1]} {self.fidelity.layers} layers of defocus, PSFs of "
                f"{self.window}x{self.window} px at {self.wavelengths[0]} of {self.wavelengths[1]} wavelengths, in "
                f"float{64 if self.fidelity.double else 32}{states}{places}",
                f"  approximates: {', '.join(parts) or 'nothing'}",
                f"  costs: {self.operations:.2g} operations, {self.operations / self.reference_operations:.2%} of the "
                f"reference's, and {self.memory_bytes / 2**20:.0f} MiB",
                *lines,
            ]
        )
