"""The conditions of a flight: weather, randomization, sensors and the scene."""
