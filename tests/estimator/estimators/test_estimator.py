import subprocess
import sys

import pytest

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators import estimator
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.estimator import create_estimator, register_estimator


def test_configuration_chooses_the_estimator():
    made = create_estimator(EstimatorConfig(estimator="elastic"))
    assert isinstance(made, ElasticEstimator)
    assert (made.name, made.device) == ("elastic", "cpu")


def test_unknown_estimator_is_a_sentence_with_the_known_ones():
    with pytest.raises(InvalidInputError, match="expected one of elastic, paper, got 'magic'"):
        create_estimator(EstimatorConfig(estimator="magic"))


def test_others_can_be_registered_once(monkeypatch):
    monkeypatch.setattr(estimator, "_factories", dict(estimator._factories))
    register_estimator("mine", ElasticEstimator)
    assert isinstance(create_estimator(EstimatorConfig(estimator="mine")), ElasticEstimator)
    with pytest.raises(InvalidInputError, match="not in use, got 'mine'"):
        register_estimator("mine", ElasticEstimator)


def test_elastic_estimator_loads_no_network():
    code = (
        "import sys; from softtissue_estimator.config import EstimatorConfig;"
        "from softtissue_estimator.estimators.estimator import create_estimator;"
        "create_estimator(EstimatorConfig(estimator='elastic'));"
        "sys.exit('softtissue_estimator.estimators.paper.network' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": ":".join(sys.path)}, check=False)
    assert done.returncode == 0
