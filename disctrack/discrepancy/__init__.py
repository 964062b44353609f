"""The search for a missing effect in any system that can be predicted; nothing here knows the disc."""
