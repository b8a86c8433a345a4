"""Store of measured values: a file of SQLite, in which each value is kept as soon as it is measured."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import NamedTuple, Self

from kornia_tidy.files import parse_json

SCHEMA = """
CREATE TABLE IF NOT EXISTS cells (
    scenes TEXT, scene TEXT, system TEXT, digest TEXT, noise TEXT, restoration TEXT, settings TEXT,
    scores TEXT NOT NULL, day TEXT NOT NULL, commit_id TEXT NOT NULL, machine TEXT NOT NULL,
    PRIMARY KEY (scenes, scene, system, digest, noise, restoration, settings)
);
CREATE TABLE IF NOT EXISTS systems (name TEXT PRIMARY KEY, digest TEXT, kind TEXT, title TEXT, f_number REAL)
"""


class Cell(NamedTuple):
    """What a value belongs to."""

    scenes: str
    scene: str
    system: str
    digest: str
    noise: str
    restoration: str
    settings: str


class SystemRow(NamedTuple):
    """A system that was measured."""

    name: str
    digest: str
    kind: str
    title: str
    f_number: float


class Provenance(NamedTuple):
    """When, from which commit and on which machine something was measured."""

    day: str
    commit: str
    machine: str


class Measured(NamedTuple):
    """Scores of a cell, and where they come from."""

    cell: Cell
    scores: dict[str, float]
    provenance: Provenance


class Store:
    """Cells by what they belong to. Each is committed when it is written, so that an interrupted run goes on.

    Two processes may write to one store.
    """

    def __init__(self, path: Path, provenance: Provenance) -> None:
        self.provenance = provenance
        self.connection = sqlite3.connect(path, timeout=60)
        self.connection.executescript(SCHEMA)

    def get(self, cell: Cell) -> dict[str, float]:
        """Return the scores of a cell; none where it was not measured."""
        where = " AND ".join(f"{name} = ?" for name in Cell._fields)
        found = self.connection.execute(f"SELECT scores FROM cells WHERE {where}", cell).fetchone()
        return {} if found is None else parse_json(found[0])

    def put(self, cell: Cell, scores: dict[str, float]) -> None:
        """Keep the scores of a cell."""
        row = (*cell, json.dumps(scores), *self.provenance)
        with self.connection:
            self.connection.execute(f"INSERT OR REPLACE INTO cells VALUES ({', '.join('?' * len(row))})", row)

    def put_system(self, row: SystemRow) -> None:
        """Keep the description of a system; from now on, values of other weights of the same name are left out."""
        with self.connection:
            self.connection.execute("INSERT OR REPLACE INTO systems VALUES (?, ?, ?, ?, ?)", row)

    def systems(self) -> dict[str, SystemRow]:
        """Return the systems by name."""
        rows = self.connection.execute("SELECT name, digest, kind, title, f_number FROM systems ORDER BY name")
        return {row[0]: SystemRow(*row) for row in rows}

    def cells(self) -> list[Measured]:
        """Return all cells of the present systems."""
        fields = ", ".join(f"cells.{name}" for name in (*Cell._fields, "scores", "day", "commit_id", "machine"))
        rows = self.connection.execute(
            f"SELECT {fields} FROM cells JOIN systems ON cells.system = systems.name AND cells.digest = systems.digest "
            f"ORDER BY {', '.join(f'cells.{name}' for name in Cell._fields)}"
        )
        return [Measured(Cell(*row[:7]), parse_json(row[7]), Provenance(*row[8:])) for row in rows]

    def __enter__(self) -> Self:
        """Return the store, which is closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        closing(self.connection).__exit__()
