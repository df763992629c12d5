"""Organ folders that tests write."""

import trimesh
import yaml

from estimator.shapes import ellipsoid, sphere

LIVER = ellipsoid((0.09, 0.06, 0.05), subdivisions=3)


TUMOUR = sphere(0.01, centre=(0.03, 0.0, 0.0), subdivisions=2)


VEIN = sphere(0.008, centre=(0.095, 0.0, 0.0), subdivisions=2)


TIP = {"spheres": [{"centre": [90, 0, 0], "radius": 25}]}


def export(mesh, path, scale=1000.0):
    trimesh.Trimesh(mesh.vertices * scale, mesh.faces, process=False).export(path)


def describe(folder, **changes):
    content = {
        "name": "Liver",
        "frame": "scan",
        "unit": "mm",
        "surface": "liver.ply",
        "structures": [{"name": "tumour", "kind": "tumour", "mesh": "tumour.ply", "colour": [1, 0.5, 0]}],
        "attached": TIP,
    }
    content = {key: value for key, value in {**content, **changes}.items() if value is not None}
    (folder / "organ.yaml").write_text(yaml.safe_dump(content))
    return folder
