"""Mutants: faults of each kind are found where they can be made, drawn by a seed, and shown to the right tests."""

from __future__ import annotations

from tests.base import BaseTester
from tests.code_mutants.mutants import KINDS, mutants_of

PYTHON = b'''
class Bank:
    """A bank of - 3 * numbers."""

    def recall(self, key: int = 3) -> Tensor:
        if key < 4 and self._known:
            self._memory.clear()
        self._kind = key
        return torch.cos(-self.psi) * 2.5
'''
C = b"""// x + 1
static void add(float *sum, long n) {
    memset(sum, 0, n);
    for (long i = 0; i < n; i++) sum[i] += -0.5 * sum[i];
}
"""


def changes(path: str, source: bytes) -> dict[str, set[str]]:
    """The new lines, by kind."""
    found: dict[str, set[str]] = {kind: set() for kind in KINDS}
    for mutant in mutants_of(path, source):
        before, after = source.decode().splitlines(), mutant.apply(source).decode().splitlines()
        assert before[mutant.line - 1] != after[mutant.line - 1]
        found[mutant.kind].add(after[mutant.line - 1].strip())
    return found


class TestMutants(BaseTester):
    def test_feature_faults_of_python(self):
        found = changes("kornia_tidy/psf/bank.py", PYTHON)
        assert "return torch.cos((self.psi)) * 2.5" in found["sign"]
        assert "return torch.sin(-self.psi) * 2.5" in found["sign"]
        assert {"if key <= 4 and self._known:", "if key < 5 and self._known:"} <= found["off-by-one"]
        assert "return torch.cos(-self.psi) * 25.0" in found["unit"]
        assert found["gradient"] == {"return (torch.cos(-self.psi) * 2.5).detach()"}
        assert found["memory"] == {"pass"}
        assert {"if True:", "if (key < 4 or self._known):"} <= found["condition"]
        assert not any("numbers" in line for lines in found.values() for line in lines)

    def test_feature_faults_of_c(self):
        found = changes("kornia_tidy/kernels/add.c", C)
        loop = "for (long i = 0; i < n; i++) sum[i] {} {}0.5 * sum[i];"
        assert found["sign"] == {loop.format("-=", "-"), loop.format("+=", "")}
        assert loop.replace("i < n", "i <= n").format("+=", "-") in found["off-by-one"]
        assert loop.format("=", "-") in found["gradient"]
        assert found["memory"] == {";"}
