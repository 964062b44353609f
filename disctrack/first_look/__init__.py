"""Before the first run: sequences in a folder, a recording.toml for it, problems of a run, sheets to print."""
