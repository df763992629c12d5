"""Where an organ is in a cloud of points that have no correspondences."""
