"""The engines: what advances rows of aircraft."""
