"""The report of a recorded operation: what the node said, in figures, curves and pictures, as one HTML page."""
