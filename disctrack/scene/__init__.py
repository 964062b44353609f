"""What a synthetic recording shows, how its disc moves, and the simulation of that motion into a file."""
