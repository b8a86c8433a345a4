"""Scenes with depth: readers for files, and scenes made by the library."""
