"""From estimates to messages."""
