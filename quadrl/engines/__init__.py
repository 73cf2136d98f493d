"""Engines: they advance rows of aircraft by physics steps."""
