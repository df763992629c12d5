"""The overlay as a node of its own: the structures on the images of a camera."""
