"""What a recording declares: `recording.toml` read into frozen dataclasses in SI units."""
