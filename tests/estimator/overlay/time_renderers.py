"""How long the overlay's renderer and VTK take to draw one mesh, every vertex of which moves from image to image.

As a program: `python tests/estimator/overlay/time_renderers.py`. VTK has a process of its own: it ends where graphics
libraries are missing.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    root = Path(__file__).parents[3]
    sys.path[:0] = [str(root / part) for part in ("tests", "softtissue_estimator")]

from estimator.shapes import ellipsoid
from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import make_camera
from softtissue_estimator.overlay.painter import paint
from softtissue_estimator.overlay.rasteriser import vertex_normals
from softtissue_estimator.overlay.scene import Placed
from softtissue_estimator.view.structures import make_structures

SIZES = ((640, 480), (1920, 1080))
IMAGES, WARM_UP = 60, 10
_AXES_M, _DISTANCE_M, _FOCAL_SHARE = (0.05, 0.035, 0.03), 0.15, 0.875
_SURFACE = ellipsoid(_AXES_M, subdivisions=5)
_VERTICES = _SURFACE.vertices + np.array([0.0, 0.0, _DISTANCE_M])
_FACES = _SURFACE.faces.astype(np.int32)


def moved(number: int) -> np.ndarray:
    """Vertices in the camera's frame on the image of that number, m."""
    swing = np.sin(2.0 * np.pi * number / 25.0 + 40.0 * _VERTICES[:, 0])
    return _VERTICES + 0.003 * swing[:, None] * np.array([0.0, 1.0, 0.0])


def median_ms(draw: Callable[[np.ndarray], None]) -> float:
    """Draw images; return the median time of one, ms."""
    seconds = []
    for number in range(WARM_UP + IMAGES):
        points = moved(number)
        began = time.perf_counter()
        draw(points)
        seconds.append(time.perf_counter() - began)
    return 1e3 * statistics.median(seconds[WARM_UP:])


def ours(columns: int, rows: int) -> float:
    """Everything that the overlay does with an image but names: lens, both bands, shading, blending."""
    ends = np.array([0, len(_VERTICES)]), np.array([0, len(_FACES)])
    structures = make_structures(("one",), ("vessel",), np.array([[0.2, 0.3, 0.9]]), *ends, _FACES)
    focal = _FOCAL_SHARE * columns
    matrix = np.array([focal, 0.0, 0.5 * (columns - 1), 0.0, focal, 0.5 * (rows - 1), 0.0, 0.0, 1.0])
    camera = make_camera((columns, rows), matrix, "plumb_bob", np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
    background = np.full((rows, columns, 3), 90, np.uint8)
    buffers, canvas, sigma = Buffers(), background.copy(), np.full(len(_VERTICES), 0.001)

    def draw(points: np.ndarray) -> None:
        np.copyto(canvas, background)
        paint(canvas, camera, structures, Placed(points, sigma, None), names=False, buffers=buffers)

    return median_ms(draw)


def with_vtk(columns: int, rows: int) -> float:
    """Points, normals and shading as VTK draws them off screen, read back; neither lens nor bands nor blending."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

    points = np.ascontiguousarray(_VERTICES, dtype=np.float32)
    normals = np.empty_like(points)
    held, mesh, cells = vtk.vtkPoints(), vtk.vtkPolyData(), vtk.vtkCellArray()
    held.SetData(numpy_to_vtk(points))
    corners = np.hstack([np.full((len(_FACES), 1), 3), _FACES]).astype(np.int64).ravel()
    cells.SetCells(len(_FACES), numpy_to_vtkIdTypeArray(corners, deep=True))
    mesh.SetPoints(held)
    mesh.SetPolys(cells)
    given = numpy_to_vtk(normals)
    mesh.GetPointData().SetNormals(given)
    mapper, actor, renderer = vtk.vtkPolyDataMapper(), vtk.vtkActor(), vtk.vtkRenderer()
    mapper.SetInputData(mesh)
    actor.SetMapper(mapper)
    renderer.AddActor(actor)
    camera = renderer.GetActiveCamera()
    camera.SetPosition(0.0, 0.0, 0.0)
    camera.SetFocalPoint(0.0, 0.0, 1.0)
    camera.SetViewUp(0.0, -1.0, 0.0)
    camera.SetViewAngle(np.degrees(2.0 * np.arctan(0.5 * rows / (_FOCAL_SHARE * columns))))
    camera.SetClippingRange(0.05, 0.5)
    window, reader, pixels = vtk.vtkRenderWindow(), vtk.vtkWindowToImageFilter(), []
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(columns, rows)
    window.AddRenderer(renderer)
    reader.SetInput(window)
    reader.ReadFrontBufferOff()

    def draw(vertices: np.ndarray) -> None:
        points[:] = vertices
        vertex_normals(points, _FACES, normals)
        held.Modified()
        given.Modified()
        mesh.Modified()
        window.Render()
        reader.Modified()
        reader.Update()
        pixels[:] = [vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())]

    found = median_ms(draw)
    share = float((pixels[0].max(axis=1) > 0).mean())
    if not 0.05 < share < 0.95:
        raise SystemExit(f"expected a mesh on a part of the image, got one on {share:.0%}")
    return found


def main(arguments: list[str]) -> None:
    """Time both and print."""
    if arguments == ["vtk"]:
        print(*(f"{with_vtk(*size):.1f}" for size in SIZES))
        return
    print(f"{len(_FACES)} triangles, median of {IMAGES} images, ms at", *(f"{c}x{r}" for c, r in SIZES))
    print("overlay:", *(f"{ours(*size):.1f}" for size in SIZES), flush=True)
    done = subprocess.run([sys.executable, __file__, "vtk"], capture_output=True, text=True)
    print("VTK:", done.stdout.strip() or f"ended with {done.returncode}, {done.stderr.strip()[-200:]}")


if __name__ == "__main__":
    main(sys.argv[1:])
