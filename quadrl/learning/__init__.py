"""Training, evaluation and their figures; needs the extra `train`."""
