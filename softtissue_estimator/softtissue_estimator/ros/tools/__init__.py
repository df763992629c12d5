"""Executables beside the node: bags played, answers scored, the demo."""
