"""What every other room stands on: errors, validation, rotations, records, files, the tracer."""
