"""Whole batches on a device: the control step as one text, compiled for a GPU."""
