"""The structures drawn on a camera's image."""
