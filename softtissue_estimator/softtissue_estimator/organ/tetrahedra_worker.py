"""Program that fills a surface with tetrahedra; knows nothing but numpy and one module of pytetwild."""

import importlib.util
import sys

import numpy as np


def main(source: str, target: str, edge: str, envelope: str) -> None:
    """Read a surface from one .npz file and write nodes and tetrahedra into another; lengths in metres."""
    # The package's __init__ would import PyVista, which pytetwild does not install and nothing here needs.
    specification = importlib.util.find_spec("pytetwild")
    if specification is None:
        sys.exit("pytetwild is not installed")
    sys.modules["pytetwild"] = importlib.util.module_from_spec(specification)
    from pytetwild.pytetwild import tetrahedralize

    with np.load(source) as surface:
        nodes, tets = tetrahedralize(
            surface["vertices"],
            surface["faces"],
            edge_length_abs=float(edge),
            epsilon=float(envelope),
            coarsen=True,
            num_threads=1,
            quiet=True,
        )
    np.savez(target, nodes=nodes, tets=tets)


if __name__ == "__main__":
    main(*sys.argv[1:])
