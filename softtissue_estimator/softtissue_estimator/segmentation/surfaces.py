"""Smooth surfaces of voxels: contour, smoothing that keeps the volume, fewer triangles."""

import igl
import numpy as np

from softtissue_estimator.organ.decimation import with_fewer_triangles
from softtissue_estimator.organ.mesh import (
    BoolArray,
    FloatArray,
    IntArray,
    SurfaceMesh,
    enclosed_volume,
    face_areas,
)
from softtissue_estimator.segmentation.segments import Segment, Segmentation

_PASS_BAND = 0.05  # of the windowed sinc filter: details of a few voxels stay, steps go
_ITERATIONS = 20
_CORRECTIONS = 6
_MOST_CORRECTION = 0.5  # of a voxel's shortest edge: how far a vertex is moved for the volume's sake


def surface_of_segment(segment: Segment, segmentation: Segmentation, most_triangles: int) -> SurfaceMesh:
    """Make the surface of a segment: wound outward, m, LPS, with the volume of its voxels.

    The contour runs in the middle between voxels inside and outside. A windowed sinc filter (Taubin, Zhang and Golub
    1996) takes its steps away; since smoothing shrinks thin things, vertices are then moved along their normals until
    the volume is that of the voxels, by half a voxel at most.

    Parameters
    ----------
    most_triangles : int
        A surface that has more is reduced to as many.
    """
    points, faces = _smooth_contour(segment.mask)
    affine = segmentation.affine
    vertices = (points + np.array(segment.start)) @ affine[:3, :3].T + affine[:3, 3]
    if np.linalg.det(affine[:3, :3]) < 0.0:  # axes of a left-handed grid turn everything inside out
        faces = faces[:, ::-1]
    mesh = SurfaceMesh(vertices, faces)
    volume = segment.count * segmentation.voxel_volume
    most = _MOST_CORRECTION * float(segmentation.spacing.min())
    mesh = _with_volume(mesh, volume, most)
    if len(mesh.faces) > most_triangles:
        mesh = _without_folds(with_fewer_triangles(mesh, most_triangles))
        mesh = _with_volume(mesh, volume, most)
    return mesh


def _smooth_contour(mask: BoolArray) -> tuple[FloatArray, IntArray]:
    """Return points in indices of the mask and triangles wound outward, as if those axes were right-handed."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkWindowedSincPolyDataFilter

    padded = np.pad(mask, 1)  # else the surface is open where the mask ends
    image = vtkImageData()
    image.SetDimensions(*padded.shape)
    values = np.ascontiguousarray(padded.ravel(order="F").view(np.uint8))
    image.GetPointData().SetScalars(numpy_to_vtk(values))  # type: ignore[no-untyped-call]
    contour = vtkFlyingEdges3D()
    contour.SetInputData(image)
    contour.SetValue(0, 0.5)
    contour.ComputeNormalsOff()
    contour.ComputeGradientsOff()
    contour.ComputeScalarsOff()
    smooth = vtkWindowedSincPolyDataFilter()
    smooth.SetInputConnection(contour.GetOutputPort())
    smooth.SetNumberOfIterations(_ITERATIONS)
    smooth.SetPassBand(_PASS_BAND)
    smooth.BoundarySmoothingOff()
    smooth.FeatureEdgeSmoothingOff()
    smooth.NonManifoldSmoothingOn()
    smooth.NormalizeCoordinatesOn()
    smooth.Update()
    surface = smooth.GetOutput()
    stored = (surface.GetPoints().GetData(), surface.GetPolys().GetConnectivityArray())
    points, corners = (np.array(vtk_to_numpy(array)) for array in stored)  # type: ignore[no-untyped-call]
    points, corners = points.astype(np.float64) - 1.0, corners.astype(np.int64).reshape(-1, 3)
    mesh = SurfaceMesh(points, corners)
    return points, corners if enclosed_volume(mesh) > 0.0 else corners[:, ::-1]


def _without_folds(mesh: SurfaceMesh) -> SurfaceMesh:
    """Drop pairs of triangles with the same corners, back to back, which collapsing edges leaves now and then."""
    faces = mesh.faces
    while True:
        _, same, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        single = count[same.reshape(-1)] == 1
        if single.all():
            break
        faces = faces[single]
    used, compact = np.unique(faces, return_inverse=True)
    return SurfaceMesh(mesh.vertices[used], compact.reshape(-1, 3))


def _with_volume(mesh: SurfaceMesh, volume: float, most: float) -> SurfaceMesh:
    """Move vertices along their normals until a surface encloses a volume, m^3, each by at most so many metres."""
    moved = 0.0
    for _ in range(_CORRECTIONS):
        area = float(face_areas(mesh).sum())
        step = float(np.clip((volume - enclosed_volume(mesh)) / area, -most - moved, most - moved))
        if abs(step) * area <= 1e-4 * volume:
            break
        normals = np.nan_to_num(np.asarray(igl.per_vertex_normals(mesh.vertices, mesh.faces)))
        mesh = SurfaceMesh(mesh.vertices + step * normals, mesh.faces)
        moved += step
    return mesh
