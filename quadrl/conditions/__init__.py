"""The conditions of a flight: weather, what is drawn for an aircraft, disturbances, sensors."""
