"""Pictures of an organ and of an estimate."""
