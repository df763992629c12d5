"""Voxels of a given surface, and distances between surfaces."""

import igl
import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

from estimator.segmentation.drawn import Grid
from softtissue_estimator.organ.mesh import sample_faces


def voxelised(path, spacing) -> tuple[np.ndarray, Grid]:
    """Voxels whose centres are inside the surface of an STL or VTK file in mm, by VTK's stencil."""
    reader = vtk.vtkSTLReader() if path.suffix == ".stl" else vtk.vtkPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    bounds = np.array(reader.GetOutput().GetBounds()).reshape(3, 2)
    origin = bounds[:, 0] - 2.0 * np.array(spacing)
    shape = tuple(int(n) for n in np.ceil(np.ptp(bounds, axis=1) / spacing) + 5)
    stencil = vtk.vtkPolyDataToImageStencil()
    stencil.SetInputConnection(reader.GetOutputPort())
    stencil.SetOutputOrigin(*origin)
    stencil.SetOutputSpacing(*spacing)
    stencil.SetOutputWholeExtent(0, shape[0] - 1, 0, shape[1] - 1, 0, shape[2] - 1)
    image = vtk.vtkImageStencilToImage()
    image.SetInputConnection(stencil.GetOutputPort())
    image.SetInsideValue(1)
    image.SetOutsideValue(0)
    image.SetOutputScalarTypeToUnsignedChar()
    image.Update()
    values = vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = origin
    return values.reshape(shape[::-1]).transpose(2, 1, 0).astype(bool), Grid(shape, affine)


def distances(surface, other) -> np.ndarray:
    """Distance of points of a surface, 2 mm apart, from another one, m."""
    points = sample_faces(surface, None, 0.002)[0]
    squared = igl.point_mesh_squared_distance(points, other.vertices, other.faces)[0]
    return np.sqrt(np.maximum(squared, 0.0))
