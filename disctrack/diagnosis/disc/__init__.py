"""The rolling disc, its cameras, table and dots as a system that the engine can diagnose."""
