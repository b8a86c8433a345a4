"""Objects are changed by themselves alone: nobody writes another object's private attributes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import kornia_tidy
from tests.base import BaseTester

PACKAGE = Path(kornia_tidy.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
# How a class makes objects of itself, whose attributes it then sets.
MAKERS = ("cls(", "cls.__new__(", "object.__new__(", "type(self)(", "copy.copy(self)", "super().__new__(")


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def written_to(node: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Objects and the private attributes of theirs that a statement or a call writes."""
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.Delete):
        targets = node.targets
    elif isinstance(node, ast.AugAssign | ast.AnnAssign):
        targets = [node.target]
    for target in targets:
        for part in ast.walk(target):
            if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store | ast.Del) and is_private(part.attr):
                yield part.value, part.attr
            # x.__dict__["_name"] = ..., vars(x)["_name"] = ...
            if isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store | ast.Del):
                yield from ((owner, "__dict__") for owner in dictionaries(part.value))
    if isinstance(node, ast.Call):
        called, arguments = node.func, node.args
        if isinstance(called, ast.Attribute) and called.attr in {"update", "pop", "setdefault", "clear"}:
            yield from ((owner, "__dict__") for owner in dictionaries(called.value))
        name = called.id if isinstance(called, ast.Name) else called.attr if isinstance(called, ast.Attribute) else ""
        if name in {"setattr", "__setattr__", "delattr"} and len(arguments) > 1:
            what = arguments[1]
            if isinstance(what, ast.Constant) and isinstance(what.value, str) and is_private(what.value):
                yield arguments[0], what.value


def dictionaries(node: ast.expr) -> Iterator[ast.expr]:
    """The object whose attributes an expression holds."""
    if isinstance(node, ast.Attribute) and node.attr == "__dict__":
        yield node.value
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "vars" and node.args:
        yield node.args[0]


def own_objects(function: ast.AST) -> set[str]:
    """Names in a function of the object itself, of its class, and of objects of its class that the function makes."""
    names = {"self", "cls"}
    for node in ast.walk(function):
        made = isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
        if made and ast.unparse(node.value).startswith(MAKERS):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def foreign_writes(source: str) -> list[str]:
    """Line, object and attribute of each write to a private attribute of another object."""
    tree, found = ast.parse(source), set()
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    names = [(function, own_objects(function)) for function in functions]
    own = {id(part): own_names for function, own_names in names for part in ast.walk(function)}
    for node in ast.walk(tree):
        for owner, name in written_to(node):
            text = ast.unparse(owner)
            marked = name.startswith("_dynamo")  # how torch's compiler is told of a function
            if text not in own.get(id(node), set()) and not marked:
                found.add(f"{node.lineno}: {text}.{name}")
    return sorted(found)


class TestPrivateAttributes(BaseTester):
    def test_feature_nobody_writes_those_of_another_object(self):
        found = {file.relative_to(PACKAGE).as_posix(): foreign_writes(file.read_text()) for file in FILES}
        assert {file: lines for file, lines in found.items() if lines} == {}

    @pytest.mark.parametrize(
        "line",
        [
            "other._x = 1",
            "other._x += 1",
            "self.other._x, y = 1, 2",
            "del other._x",
            "setattr(other, '_x', 1)",
            "object.__setattr__(other, '_x', 1)",
            "other.__dict__['_x'] = 1",
            "other.__dict__.update(_x=1)",
            "vars(other).update(_x=1)",
        ],
    )
    def test_feature_the_rule_sees_every_way_to_write(self, line):
        assert foreign_writes(f"def f(self, other):\n    {line}\n")
