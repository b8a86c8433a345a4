"""Mutants: small faults put into the package's code, and whether the tests notice. ``python -m tests.code_mutants``."""
