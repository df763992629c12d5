"""Which sources of the estimator a stored result depends on."""

from softtissue_training.core_sources import core_sources


def test_the_core_is_all_but_the_node():
    names = {path.name for path in core_sources()}
    assert {"mesh.py", "hyperelastic.py", "vtk_files.py"} <= names
    assert "estimator_node.py" not in names
    assert core_sources() == sorted(core_sources())
