"""OpenIGTLink, by which 3D Slicer and other programs of image-guided therapy hear of surfaces, transforms and words."""
