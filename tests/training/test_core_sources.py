"""Which sources of the estimator a stored result depends on."""

from softtissue_training.core_sources import core_sources, imported_sources


def test_the_core_is_all_but_the_node():
    names = {path.name for path in core_sources()}
    assert {"mesh.py", "hyperelastic.py", "vtk_files.py"} <= names
    assert "estimator_node.py" not in names
    assert core_sources() == sorted(core_sources())


def test_imports_are_followed_through_packages():
    found = imported_sources(["estimators.hybrid.posterior"])
    assert list(found) == sorted(found)
    assert {
        "estimators.hybrid.posterior",
        "estimators.elastic.estimate",
        "estimators.elastic.loads",
        "organ.mesh",
    } <= set(found)
    assert all(path.is_file() for path in found.values())
    assert not {"ros.estimator_node", "estimators.paper.estimator"} & set(found)


def test_what_has_no_influence_is_not_followed():
    found = imported_sources(["estimators.elastic.estimator"], {"inference", "organ.organ"})
    assert {"estimators.elastic.solver", "organ.mesh"} <= set(found)
    assert not {"inference.device", "inference.stopwatch", "organ.organ", "organ.organ_file"} & set(found)
