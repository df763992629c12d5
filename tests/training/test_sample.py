import numpy as np

from softtissue_training.sample import simulate

from .conftest import ELEMENT_SIZE_M


def test_the_seed_and_number_decide(samples):
    again, _ = simulate(3, 1, edge_length_m=ELEMENT_SIZE_M)
    other, _ = simulate(4, 1, edge_length_m=ELEMENT_SIZE_M)
    np.testing.assert_array_equal(again.displacement, samples[1].displacement)
    np.testing.assert_array_equal(again.tets, samples[1].tets)
    assert other.vertices.shape != again.vertices.shape or not np.allclose(other.vertices, again.vertices)


def test_attached_vertices_stay_and_others_move(samples):
    for sample in samples:
        length = np.linalg.norm(sample.displacement, axis=1)
        assert len(sample.attached) >= 4
        assert (length[sample.attached] == 0.0).all()
        assert 0.0 < length.max() <= 0.10
        assert np.linalg.norm(sample.force.sum(axis=0)) <= 1.0


def test_pushed_patch_moves_along_with_the_force(samples):
    for sample in samples:
        assert float(np.sum(sample.force * sample.displacement)) > 0.0


def test_rejections_are_counted():
    counted = {}
    for number in range(8):
        _, rejected = simulate(11, number, edge_length_m=ELEMENT_SIZE_M)
        for reason, times in rejected.items():
            counted[reason] = counted.get(reason, 0) + times
    known = {
        "shape",
        "mesh",
        "patch too small",
        "load on attachment",
        "not converged",
        "moved too far",
        "left the cube",
    }
    assert counted
    assert set(counted) <= known
