"""Aircraft: rotors, vehicles, effects of the air, and the rows of parameters that engines use."""
