"""Version of the package, which ``__init__.py`` exports; lower packages read it here."""

__version__ = "0.2.0"
