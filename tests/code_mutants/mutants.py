"""Faults that could be made in the package's code, found in its source and drawn by a seed.

Six kinds: signs, off-by-ones, units (factors and powers of ten), gradients that are dropped, memories that go stale,
and conditions. Each replaces a few characters, so that a mutant is the file with one slip of the pen.
"""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

HEART = ("psf", "render", "kernels", "camera", "sensor", "accuracy")
SETS = ("heart", "others")  # these packages, and all other files of the package
KINDS = ("sign", "off-by-one", "unit", "gradient", "memory", "condition")


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Args:
        path: file, from the root of the checkout.
        function: the function's qualified name as Python gives it; empty outside of functions and in C.
        line: counted from 1.
        kind: one of :data:`KINDS`.
        start: byte of the file at which the replacement begins.
        end: byte behind it.
        new: text that replaces it.
    """

    path: str
    function: str
    line: int
    kind: str
    start: int
    end: int
    new: str

    def apply(self, source: bytes) -> bytes:
        """Return the file with the fault."""
        return source[: self.start] + self.new.encode() + source[self.end :]

    def told(self, source: bytes) -> str:
        """Return place, kind, old and new text in one line."""
        old = " ".join(source[self.start : self.end].decode().split())
        return f"{self.path}:{self.line} {self.kind}: {old[:80]!r} -> {' '.join(self.new.split())[:80]!r}"


def draw_mutants(root: Path, set_: str, count: int, seed: int) -> list[Mutant]:
    """Return different mutants of a checkout; fewer from the same seed are the first of them.

    The kinds take turns. A file is drawn by its number of lines, then one of its places for the kind.

    Args:
        root: the checkout.
        set_: one of :data:`SETS`.
        count: how many.
        seed: of the draw.
    """
    random_ = random.Random(seed)
    package = root / "kornia_tidy"
    files = [p for p in sorted(package.rglob("*")) if is_code(p)]
    files = [p for p in files if (p.relative_to(package).parts[0] in HEART) == (set_ == "heart")]
    found = {path: mutants_of(path.relative_to(root).as_posix(), path.read_bytes()) for path in files}
    lines = [len(path.read_bytes().splitlines()) for path in found]
    drawn: dict[Mutant, None] = {}
    while len(drawn) < count:
        kind = KINDS[len(drawn) % len(KINDS)]
        mutants = [m for m in found[random_.choices(list(found), lines)[0]] if m.kind == kind]
        if mutants:
            drawn.setdefault(random_.choice(mutants))
    return list(drawn)


def is_code(path: Path) -> bool:
    """Return whether a file is a source in Python or C."""
    return path.suffix in {".py", ".c", ".h"}


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """Return all mutants of a file.

    Args:
        path: its name, from the root of the checkout.
        source: its content.
    """
    if path.endswith(".py"):
        return list(_PythonMutants(path, source).all())
    return list(_c_mutants(path, source))


# ---------------------------------------------------------------------- Python

_OPPOSITE: dict[type, tuple[type, str]] = {
    ast.Add: (ast.Sub, "sign"),
    ast.Sub: (ast.Add, "sign"),
    ast.Mult: (ast.Div, "unit"),
    ast.Div: (ast.Mult, "unit"),
    ast.Lt: (ast.LtE, "off-by-one"),
    ast.LtE: (ast.Lt, "off-by-one"),
    ast.Gt: (ast.GtE, "off-by-one"),
    ast.GtE: (ast.Gt, "off-by-one"),
    ast.Eq: (ast.NotEq, "condition"),
    ast.NotEq: (ast.Eq, "condition"),
    ast.Is: (ast.IsNot, "condition"),
    ast.IsNot: (ast.Is, "condition"),
    ast.And: (ast.Or, "condition"),
    ast.Or: (ast.And, "condition"),
}
_NAMES = {
    "sin": ("cos", "sign"),
    "cos": ("sin", "sign"),
    "floor": ("ceil", "off-by-one"),
    "ceil": ("floor", "off-by-one"),
    "min": ("max", "condition"),
    "max": ("min", "condition"),
    "amin": ("amax", "condition"),
    "amax": ("amin", "condition"),
}
_FORGETS = {"clear", "pop", "popitem", "reset", "forget", "discard"}  # a memory that is not told goes stale
_COPIES = {"clone", "copy", "deepcopy"}  # shared memory changes under its reader
_REMEMBERS = re.compile("key|mark|version|stamp|memory|memories|cache|remember|known|digest", re.IGNORECASE)
_TEXT = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp)  # their sum is text or a list


class _PythonMutants(ast.NodeVisitor):
    """The mutants of a source in Python."""

    def __init__(self, path: str, source: bytes) -> None:
        self._path, self._source, self._found = path, source, list[Mutant]()
        starts = [0]
        for line in source.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self._starts = starts
        self._within: list[str] = []
        self._functions: list[ast.FunctionDef | ast.AsyncFunctionDef] = []

    def all(self) -> list[Mutant]:
        """Return them in the order of the source."""
        self.visit(ast.parse(self._source))
        return sorted(self._found, key=lambda m: (m.start, m.end, m.new))

    def _add(self, node: ast.AST, kind: str, new: str) -> None:
        start = self._starts[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]
        end = self._starts[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]
        function = ".".join(self._within).removesuffix(".<locals>") if self._functions else ""
        self._found.append(Mutant(self._path, function, node.lineno, kind, start, end, new))  # type: ignore[attr-defined]

    # ------------------------------------------------------------------ exclusions, and names of functions

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave out texts."""

    def visit_Import(self, node: ast.Import) -> None:
        """Leave out imports."""

    visit_ImportFrom = visit_Import  # type: ignore[assignment]

    def visit_Raise(self, node: ast.Raise) -> None:
        """Leave out errors."""

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """Know the class; decorators and bases are left out."""
        self._within.append(node.name)
        for child in node.body:
            self.visit(child)
        self._within.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        """Know the function; annotations and decorators are left out."""
        for default in (*node.args.defaults, *node.args.kw_defaults):
            if default is not None:
                self.visit(default)  # evaluated outside the function
        if any(ast.unparse(d).endswith("overload") for d in node.decorator_list) or node.name == "__repr__":
            return
        self._within += [node.name, "<locals>"]
        self._functions.append(node)
        for child in node.body:
            self.visit(child)
        self._functions.pop()
        del self._within[-2:]

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_Lambda(self, node: ast.Lambda) -> None:
        """Only the body."""
        self.visit(node.body)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Only the value."""
        if node.value is not None:
            self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        """Swap an operator by its neighbour."""
        for i, operator in enumerate(node.ops):
            if type(operator) in _OPPOSITE:
                other, kind = _OPPOSITE[type(operator)]
                operators = [*node.ops[:i], other(), *node.ops[i + 1 :]]
                self._add(node, kind, ast.unparse(ast.Compare(node.left, operators, node.comparators)))
        self.generic_visit(node)

    # ------------------------------------------------------------------ signs, factors, numbers

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Plus for minus, times for over, a factor less."""
        numbers = not any(isinstance(n, _TEXT) or _is_text(n) for n in (node.left, node.right))
        if type(node.op) in _OPPOSITE and numbers:
            other, kind = _OPPOSITE[type(node.op)]
            self._add(node, kind, f"({ast.unparse(ast.BinOp(node.left, other(), node.right))})")
            if kind == "unit":
                self._add(node, kind, f"({ast.unparse(node.left)})")
        if isinstance(node.op, ast.FloorDiv):
            self._add(node, "off-by-one", f"({ast.unparse(node)} + 1)")
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """The same in place."""
        if type(node.op) in _OPPOSITE and not isinstance(node.value, _TEXT):
            other, kind = _OPPOSITE[type(node.op)]
            self._add(node, kind, ast.unparse(ast.AugAssign(node.target, other(), node.value)))
        self.visit(node.value)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """A minus or a not that is forgotten."""
        if isinstance(node.op, ast.USub):
            self._add(node, "sign", f"({ast.unparse(node.operand)})")
        if isinstance(node.op, ast.Not):
            self._add(node, "condition", f"({ast.unparse(node.operand)})")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """One more, one less, ten times as much, the other truth."""
        if isinstance(node.value, bool):
            self._add(node, "condition", str(not node.value))
        elif isinstance(node.value, int):
            self._add(node, "off-by-one", str(node.value + 1))
            self._add(node, "off-by-one", str(node.value - 1) if node.value else "(-1)")
        elif isinstance(node.value, float) and node.value:
            self._add(node, "unit", repr(node.value * 10))
            self._add(node, "unit", repr(node.value / 10))

    def visit_Name(self, node: ast.Name) -> None:
        """Another function of the same kind."""
        if isinstance(node.ctx, ast.Load) and node.id in _NAMES:
            other, kind = _NAMES[node.id]
            self._add(node, kind, other)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        """Another method of the same kind."""
        if isinstance(node.ctx, ast.Load) and node.attr in _NAMES:
            other, kind = _NAMES[node.attr]
            self._add(node, kind, f"{ast.unparse(node.value)}.{other}")
        self.generic_visit(node)

    # ------------------------------------------------------------------ conditions

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """And for or; one part forgotten."""
        other, kind = _OPPOSITE[type(node.op)]
        self._add(node, kind, f"({ast.unparse(ast.BoolOp(other(), node.values))})")
        for i in range(len(node.values)):
            values = node.values[:i] + node.values[i + 1 :]
            fewer = values[0] if len(values) == 1 else ast.BoolOp(node.op, values)
            self._add(node, "condition", f"({ast.unparse(fewer)})")
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        """Always, and never."""
        self._add(node.test, "condition", "True")
        self._add(node.test, "condition", "False")
        self.generic_visit(node)

    visit_IfExp = visit_If  # type: ignore[assignment]

    # ------------------------------------------------------------------ gradients and memories

    def visit_Return(self, node: ast.Return) -> None:
        """A gradient that ends here; a part of what names a memory."""
        if node.value is not None and self._functions:
            function = self._functions[-1]
            if function.returns is not None and ast.unparse(function.returns) == "Tensor":
                self._add(node.value, "gradient", f"({ast.unparse(node.value)}).detach()")
            if re.search("backward|gradient", function.name) and isinstance(node.value, ast.Tuple):
                for part in node.value.elts:
                    if not (isinstance(part, ast.Constant) and part.value is None):
                        self._add(part, "gradient", "None")
            if _REMEMBERS.search(function.name):
                self._fewer(node.value)
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        """End a gradient here, forget a part of a key, or a value."""
        if isinstance(node.value, ast.Call) and ast.unparse(node.value.func).startswith("torch.") and self._functions:
            self._add(node.value, "gradient", f"({ast.unparse(node.value)}).detach()")
        targets = " ".join(ast.unparse(target) for target in node.targets)
        if _REMEMBERS.search(targets):
            self._fewer(node.value)
        function = self._functions[-1].name if self._functions else "__init__"
        if function != "__init__" and re.fullmatch(r"\w+\.\w+|.*\[.*\]", targets) and isinstance(node.value, ast.AST):
            self._add(node, "memory", "pass")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        """A memory that is not cleared."""
        if isinstance(node.value, ast.Constant):
            return  # a docstring
        called = node.value.func if isinstance(node.value, ast.Call) else None
        if isinstance(called, ast.Attribute) and called.attr in _FORGETS:
            self._add(node, "memory", "pass")
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        """A part of a memory's key."""
        if _REMEMBERS.search(ast.unparse(node.value)):
            self._fewer(node.slice)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        """Copies and detachments that are forgotten, parts of a key."""
        function = node.func
        if isinstance(function, ast.Attribute) and not node.args and not node.keywords:
            if function.attr in _COPIES:
                self._add(node, "memory", ast.unparse(function.value))
            if function.attr == "detach":
                self._add(node, "gradient", ast.unparse(function.value))
        if _REMEMBERS.search(ast.unparse(function)):
            for argument in node.args:
                self._fewer(argument)
        self.generic_visit(node)

    def _fewer(self, node: ast.expr) -> None:
        """A tuple without one of its parts."""
        if isinstance(node, ast.Tuple) and len(node.elts) > 1 and not any(isinstance(e, ast.Slice) for e in node.elts):
            for i in range(len(node.elts)):
                self._add(node, "memory", f"({ast.unparse(ast.Tuple(node.elts[:i] + node.elts[i + 1 :], ast.Load()))})")


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


# ---------------------------------------------------------------------- C

_C_RULES: list[tuple[str, str, Callable[[re.Match[str]], Iterable[str]]]] = [
    ("sign", r"(?<=[\w)\]] )[+-](?= )", lambda m: ["-" if m[0] == "+" else "+"]),
    ("sign", r"(?<=[=(,?:] )-(?=[\w(])|(?<=\()-(?=[\w(])", lambda m: [""]),
    ("sign", r"[+-](?==)", lambda m: ["-" if m[0] == "+" else "+"]),
    ("off-by-one", r"(?<![\w.])\d+(?![\w.])", lambda m: [str(int(m[0]) + 1), str(int(m[0]) - 1)]),
    ("off-by-one", r"(?<= )[<>](?= )", lambda m: [m[0] + "="]),
    ("off-by-one", r"(?<= )[<>]=(?= )", lambda m: [m[0][0]]),
    ("unit", r"(?<=[\w)\]] )[*/](?= )", lambda m: ["/" if m[0] == "*" else "*"]),
    ("unit", r"(?<![\w.])\d+\.\d*(?:e[+-]?\d+)?", lambda m: [repr(float(m[0]) * 10), repr(float(m[0]) / 10)]),
    ("gradient", r"(?<= )\+=(?= )", lambda m: ["="]),  # a part of a sum is lost
    ("gradient", r"(?<=[;{}\n])\s*(?P<statement>[\w\[\]>.-]+ \+= [^;{}]*;)", lambda m: [";"]),
    ("memory", r"(?<=[;{}\n])\s*(?P<statement>memset\([^;]*;)", lambda m: [";"]),  # old values are read
    ("memory", r"(?<=[;{}\n])\s*(?P<statement>[\w\[\]>.-]+ = (?:0|\(vec\)\{0\});)", lambda m: [";"]),
    ("condition", r"(?<=if \()[^()]*(?:\([^()]*\)[^()]*)*(?=\))", lambda m: ["1", "0"]),
    ("condition", r"&&|\|\|", lambda m: ["||" if m[0] == "&&" else "&&"]),
    ("condition", r"\b(?:least|most|MIN|MAX)\b(?=\()", lambda m: [_C_OTHER[m[0]]]),
]
_C_OTHER = {"least": "most", "most": "least", "MIN": "MAX", "MAX": "MIN"}
_NO_CODE = re.compile(
    r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\])*"|^#(?:include|pragma|if|ifdef|ifndef|elif|error)[^\n]*', re.S | re.M
)


def _c_mutants(path: str, source: bytes) -> Iterator[Mutant]:
    """The mutants of a source in C; its comments, texts and directives other than macros are left out."""
    text = source.decode()
    if len(text) != len(source):  # places are counted in bytes
        text = source.decode("latin-1")
    code = _NO_CODE.sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)
    found = {
        (*match.span("statement" if "statement" in match.re.groupindex else 0), new, kind)
        for kind, pattern, news in _C_RULES
        for match in re.finditer(pattern, code)
        for new in news(match)
    }
    for start, end, new, kind in sorted(found):
        yield Mutant(path, "", text.count("\n", 0, start) + 1, kind, start, end, new)
