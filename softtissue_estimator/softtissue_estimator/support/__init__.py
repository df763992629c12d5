"""Caches, bundled files, threads and log lines: nothing of the field."""
