"""What pyproject.toml cannot say: where the estimator lies, which is in no index."""

from pathlib import Path

from setuptools import setup

ESTIMATOR = Path(__file__).resolve().parents[1] / "softtissue_estimator"
# Beside this folder in the repository; elsewhere it must be installed already.
place = f" @ {ESTIMATOR.as_uri()}" if (ESTIMATOR / "pyproject.toml").is_file() else ""

setup(
    install_requires=[
        f"softtissue-estimator{place}",
        "bokeh",
        "distributed",
        "gmsh",
        "libigl",
        "matplotlib",
        "meshio",
        "numpy",
        "psutil",
        "rosbags",
        "safetensors",
        "scipy",
        "torch",
        "torch-fem",
        "tqdm",
        "trimesh",
    ],
)
