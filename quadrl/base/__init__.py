"""The base of all other packages: errors, validation, rotations, records, files, the tracer."""
