"""What a stage tells its user: blocks that it fills, numbers as people write them, and the writers."""
