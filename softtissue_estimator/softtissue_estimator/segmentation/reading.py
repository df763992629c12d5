"""Read a segmentation from whatever kind of file it is in; what is wrong with the file is one sentence."""

import contextlib
import importlib.util
import io
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import InvalidInputError, MissingDependencyError
from softtissue_estimator.segmentation.dicom_files import is_dicom, read_dicom
from softtissue_estimator.segmentation.nifti_files import NIFTI_FORMATS, read_nifti
from softtissue_estimator.segmentation.nrrd_files import NRRD_FORMATS, read_nrrd
from softtissue_estimator.segmentation.segments import Segmentation
from softtissue_estimator.support.files import is_file

Reader = Callable[[Path], Segmentation]
_EXPECTED = "expected a segmentation as .seg.nrrd, .nrrd, .nii, .nii.gz or DICOM SEG"


def read_segmentation(path: Path) -> Segmentation:
    """Read the segments of a file: NRRD (`.seg.nrrd` of 3D Slicer), NIfTI or DICOM SEG.

    Raises
    ------
    InvalidInputError
        If it is none of them, is damaged, or does not say where its voxels are in the patient.
    MissingDependencyError
        If the library for its kind is not installed.
    """
    where = f"segmentation {path}"
    if not is_file(path):
        raise InvalidInputError(f"{where}: expected a file, found {'a folder' if path.is_dir() else 'none'}")
    try:
        reader, library = _reader(path)
    except OSError as error:
        raise InvalidInputError(
            f"{where}: expected a file that can be read, got '{error.strerror}'"
        ) from error
    require(library)
    try:
        # Libraries warn of what is odd in a header, on the terminal; what matters of it is checked here.
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return reader(path)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error
    except Exception as error:  # libraries raise whatever a damaged file makes them stumble over
        raise InvalidInputError(
            f"{where}: {_EXPECTED}, got a file that cannot be read as its name says ({type(error).__name__})"
        ) from error


def require(module: str) -> None:
    """Raise MissingDependencyError if a library of the extra `import` is not installed."""
    names = {"nrrd": "pynrrd", "vtkmodules": "vtk"}
    if importlib.util.find_spec(module) is None:
        package = names.get(module, module)
        raise MissingDependencyError(
            f"import: expected the library {package}, got none; pip install {package}, or softtissue_estimator with "
            "[import]"
        )


def _reader(path: Path) -> tuple[Reader, str]:
    name = path.name.lower()
    if name.endswith(NRRD_FORMATS):
        return read_nrrd, "nrrd"
    if name.endswith(NIFTI_FORMATS):
        return read_nifti, "nibabel"
    if is_dicom(path):
        return read_dicom, "pydicom"
    raise InvalidInputError(f"segmentation {path}: {_EXPECTED}, got a file of another kind")
