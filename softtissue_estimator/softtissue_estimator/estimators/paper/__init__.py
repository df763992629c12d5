"""The published method: a 3D U-Net on a voxel grid (Pfeiffer et al. 2019)."""
