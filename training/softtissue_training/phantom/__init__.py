"""The bundled phantom: a liver-like organ made from a seed, pushed in finite elements and observed by a sensor."""
