"""Version of the package, which ``__init__.py`` exports; here what lies below can read it too."""

__version__ = "0.1.0"
