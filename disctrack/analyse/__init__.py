"""The analysis stage: a trajectory becomes motion, contact, energy and scaling laws, and a report."""
