"""Before the first run: what lies in a folder, a recording.toml for it, what a run would trip over, what to print."""
