"""Which sources of the estimator a stored result depends on."""

from softtissue_training.core_sources import core_sources, imported_sources


def test_the_core_is_all_but_the_node():
    names = {path.name for path in core_sources()}
    assert {"mesh.py", "hyperelastic.py", "vtk_files.py"} <= names
    assert "estimator_node.py" not in names
    assert core_sources() == sorted(core_sources())


def test_imports_are_followed_through_packages():
    found = imported_sources(["hybrid.posterior"])
    assert list(found) == sorted(found)
    assert {"hybrid.posterior", "elastic.estimator", "elastic.loads", "mesh"} <= set(found)
    assert all(path.is_file() for path in found.values())
    assert not {"estimator_node", "paper_estimator"} & set(found)


def test_what_has_no_influence_is_not_followed():
    found = imported_sources(["elastic.estimator"], {"inference", "organ"})
    assert "elastic.solver" in found
    assert not {"inference.device", "stopwatch", "organ", "organ_file"} & set(found)
