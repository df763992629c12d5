"""The bridge to 3D Slicer as a node of its own: the node's answers as messages of OpenIGTLink."""
