"""Cells of mesh files, format by format; `mesh_io` chooses."""
