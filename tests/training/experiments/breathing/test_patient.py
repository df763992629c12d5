"""The breathing experiment on a patient's liver as its authors left it; its second state is simulated."""

import json

import numpy as np
import pytest
import trimesh
import yaml

from recorded_data import PATIENT
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_training.cli import main

STRUCTURES = {"portal vein": "portal_vein", "hepatic veins": "hepatic_veins", "tumours": "liver_tumours"}

pytestmark = pytest.mark.skipif(not PATIENT.is_dir(), reason=f"no patient's meshes in {PATIENT}")


def bent(points, hinge):
    """Turn points (mm) about an axis through the hinge, the more the further away they are: smooth, at rest at it."""
    offset = points - hinge
    far = np.clip(np.linalg.norm(offset, axis=1) / 150.0, 0.0, 1.0)
    angle = np.radians(10.0) * far**2 * (3.0 - 2.0 * far)
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = offset.T
    return hinge + np.stack([c * x + s * z, y, c * z - s * x], axis=1)


def write_patient_case(folder):
    """A case whose organ lies where it came, and whose second state is written as STL in another pose."""
    folder.mkdir(parents=True)
    liver = read_mesh(PATIENT / "liver.vtk", 1.0).mesh
    veins = read_mesh(PATIENT / "hepatic_veins.vtk", 1.0).mesh
    hinge = veins.vertices[veins.vertices[:, 2].argmax()]
    turn = trimesh.transformations.rotation_matrix(0.1, [1.0, 2.0, -1.0])[:3, :3]

    def write(mesh, name):
        after = bent(mesh.vertices, hinge) @ turn.T + [20.0, -10.0, 30.0]
        trimesh.Trimesh(after, mesh.faces, process=False).export(folder / f"{name}_after.stl")

    write(liver, "liver")
    for name in STRUCTURES.values():
        write(read_mesh(PATIENT / f"{name}.vtk", 1.0).mesh, name)
    organ = {
        "name": "Patient's liver",
        "unit": "mm",
        "surface": str(PATIENT / "liver.vtk"),
        "structures": [
            {
                "name": name,
                "kind": "tumour" if name == "tumours" else "vessel",
                "mesh": str(PATIENT / f"{file}.vtk"),
            }
            for name, file in STRUCTURES.items()
        ],
        "attached": {"spheres": [{"centre": [float(x) for x in hinge], "radius": 45.0}]},
    }
    (folder / "organ.yaml").write_text(yaml.safe_dump(organ))
    case = {
        "unit": "mm",
        "system": "LPS",
        "surface_after": "liver_after.stl",
        "structures_after": [
            {"name": name, "mesh": f"{file}_after.stl"} for name, file in STRUCTURES.items()
        ],
    }
    (folder / "case.yaml").write_text(yaml.safe_dump(case))
    return folder


def test_command_reports_on_a_patients_liver(tmp_path, capsys):
    case, out = write_patient_case(tmp_path / "case"), tmp_path / "out"
    options = ["--estimators", "zero,rigid", "--correspondences", "cpd", "--steps", "2", "--workers", "0"]
    assert main(["evaluate", "breathing", str(case), "--out", str(out), *options]) == 0
    assert "rigid alignment alone" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    assert report["case"] == "Patient's liver"
    # The pose, and part of the bend; a liver that was turned upside down would be far off.
    assert np.degrees(0.1) < report["alignment"]["rotation_degrees"] < 25.0
    assert report["alignment"]["rms_mm"] < 8.0
    for entry in report["estimators"].values():
        assert [step["failed"] for step in entry["steps"]] == [None, None]
        assert set(entry["steps"][0]["structures"]) == set(STRUCTURES)
        assert entry["steps"][0]["visible_share"] == 1.0
        assert 0.2 < entry["steps"][1]["visible_share"] < 0.8
        # Aligned, the vessels are off by millimetres: neither by nothing nor by the pose.
        assert 0.2 < entry["vessels_mm"]["after"]["mean"] < 10.0
        assert 0.0 < entry["dice"]["after"] < 1.0
    # Without a truth there is no target registration error.
    assert "tre_mm" not in report["estimators"]["zero"]
    assert report["estimators"]["zero"]["dice"]["after"] == report["rigid_alignment_alone"]["dice"]
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 2 and "Patient" in page
