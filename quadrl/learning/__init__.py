"""Training, evaluation and their figures; needs the extra `train`."""

from quadrl.rendering import gl

gl.shield_triton()  # torchrl imports triton, perhaps after a picture
