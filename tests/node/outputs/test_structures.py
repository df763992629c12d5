"""`~/structures` draws `~/deformed_points` without the organ's folder."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import write_organ
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.ros.outputs.structures import structures_message


def test_triangles_of_the_rows_are_those_of_the_meshes(tmp_path):
    organ = load_organ(write_organ(tmp_path / "organ"))
    message = structures_message(organ)
    assert (message.organ, message.header.frame_id) == ("Test organ", "organ")
    assert (message.names, message.kinds) == (["tumour", "vessel"], ["tumour", "vessel"])
    faces = np.asarray(message.faces).reshape(-1, 3)
    for i, structure in enumerate(organ.structures):
        rows = slice(message.first_vertex[i], message.first_vertex[i + 1])
        assert set(organ.structure_index[rows]) == {i}
        mine = faces[message.first_face[i] : message.first_face[i + 1]]
        corners = structure.mesh.vertices[structure.mesh.faces]
        np.testing.assert_array_equal(organ.structure_points[mine], corners)
        colour = message.colours[i]
        np.testing.assert_allclose([colour.r, colour.g, colour.b, colour.a], structure.colour, atol=1e-6)
    assert message.first_vertex[-1] == len(organ.structure_points)
    assert message.first_face[-1] == len(faces)
    outer = np.asarray(message.surface_faces).reshape(-1, 3)
    np.testing.assert_array_equal(outer, organ.surface.faces)
