"""Executable `record`: topics into a bag."""
