"""The bundled phantom: a liver-like organ made from a seed, pushed in a finite-element model and seen by a sensor."""
