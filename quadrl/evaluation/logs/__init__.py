"""Logs of flights, a reader for each format."""
