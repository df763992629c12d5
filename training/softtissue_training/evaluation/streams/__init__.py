"""The benchmark's suite of organs that move, seen by a camera whose data are wrong in the ways of an operating room."""
