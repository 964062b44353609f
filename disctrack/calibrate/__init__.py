"""The calibration stage: views of a recording, or of two file patterns, become a rig file with its pictures."""
