"""The declaration of a recording, `recording.toml`, and readers of its frames."""
