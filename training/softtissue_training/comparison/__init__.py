"""The same bodies and loads solved by other programs: independent references, and what they cost."""
