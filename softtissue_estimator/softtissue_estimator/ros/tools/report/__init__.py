"""Executable `report`: one HTML page of a recorded operation."""
