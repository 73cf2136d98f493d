"""The version of quadrl."""

__version__ = "0.1.0"
