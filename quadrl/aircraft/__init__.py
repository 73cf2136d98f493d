"""What is flown: rotors, the vehicle, the air about it, and the row of numbers that engines fly."""
