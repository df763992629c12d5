"""The organ as scanned: files, checks, repair, surfaces and tetrahedra."""
