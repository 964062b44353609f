"""Reports of the stages: their blocks, and writers for terminal, HTML and JSON."""
