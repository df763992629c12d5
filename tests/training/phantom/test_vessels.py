import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.phantom.tumour import place_tumour
from softtissue_training.phantom.vessels import VesselTree, grow_tree, interior_points, spread

BOX = (np.full(3, -0.06), np.full(3, 0.06))


def organ(points):
    return np.linalg.norm(points, axis=1) - 0.05


@pytest.fixture(scope="module")
def tree():
    rng = np.random.default_rng(4)
    return grow_tree(
        organ, np.array([0.0, 0.0, -0.04]), 7, interior_points(organ, BOX, 0.008, 200, rng), 0.002
    )


def children(tree, node):
    return np.flatnonzero(tree.parent == node)


def test_radii_follow_murrays_law(tree):
    for node in range(len(tree.nodes)):
        below = children(tree, node)
        if len(below) == 0:
            assert tree.radius[node] == pytest.approx(0.002)
        else:
            assert tree.radius[node] ** 3 == pytest.approx((tree.radius[below] ** 3).sum())


def test_tree_has_one_root_and_parents_come_first(tree):
    np.testing.assert_allclose(tree.nodes[0], [0.0, 0.0, -0.04])
    assert tree.parent[0] == -1
    assert np.all(tree.parent[1:] >= 0) and np.all(tree.parent[1:] < np.arange(1, len(tree.parent)))


def test_ends_are_no_more_than_asked_for(tree):
    ends = [node for node in range(len(tree.nodes)) if len(children(tree, node)) == 0]
    # An end on the way to another one is not an end any more.
    assert 4 <= len(ends) <= 7


def test_same_generator_state_grows_the_same_tree(tree):
    rng = np.random.default_rng(4)
    again = grow_tree(
        organ, np.array([0.0, 0.0, -0.04]), 7, interior_points(organ, BOX, 0.008, 200, rng), 0.002
    )
    np.testing.assert_array_equal(again.nodes, tree.nodes)


def test_tube_is_inside_out_to_its_radius():
    tube = VesselTree(np.array([[0.0, 0, 0], [0.04, 0, 0]]), np.array([-1, 0]), np.array([0.003, 0.003]))
    points = np.array([[0.02, 0.0, 0.0], [0.02, 0.0029, 0.0], [0.02, 0.0031, 0.0], [0.02, 0.03, 0.0]])
    np.testing.assert_allclose(tube(points), [-0.003, -0.0001, 0.0001, 0.01], atol=1e-12)


def test_root_outside_the_organ_is_refused():
    with pytest.raises(InvalidInputError, match="root inside the organ"):
        grow_tree(organ, np.array([0.0, 0.0, 0.08]), 2, np.zeros((5, 3)), 0.002)


def test_too_few_candidates_are_refused():
    with pytest.raises(InvalidInputError, match="at least 9 points to grow through, got 5"):
        grow_tree(organ, np.zeros(3), 9, np.zeros((5, 3)), 0.002)


def test_inner_points_keep_their_depth_and_the_free_side():
    rng = np.random.default_rng(0)
    points = interior_points(organ, BOX, 0.02, 300, rng, free=lambda p: p[:, 0] > 0.0)
    assert points.shape == (300, 3)
    assert np.linalg.norm(points, axis=1).max() < 0.03
    assert points[:, 0].min() > 0.0


def test_no_room_for_inner_points_is_an_error():
    with pytest.raises(InvalidInputError, match="expected room for 10 points"):
        interior_points(organ, BOX, 0.06, 10, np.random.default_rng(0))


def test_spread_takes_the_farthest_first():
    line = np.stack([[0.0, 1.0, 2.0, 5.0, 10.0], np.zeros(5), np.zeros(5)], axis=1)
    np.testing.assert_array_equal(spread(line, 2, first=0), [4, 3])


def test_tumour_keeps_clear_of_both_vessels():
    vessels = (np.array([[-0.02, 0.0, 0.0]]), np.array([[0.02, 0.0, 0.0]]))
    candidates = np.array([[0.0, 0.0, 0.0], [0.018, 0.0, 0.0], [0.0, 0.03, 0.0]])
    tumour = place_tumour(candidates, vessels, 0.014, 0.002, np.random.default_rng(1))
    np.testing.assert_array_equal(tumour.centre, candidates[0])
    assert tumour(vessels[0])[0] > 0.0 and tumour(vessels[1])[0] > 0.0
    assert tumour(candidates[:1])[0] < -0.012


def test_tumour_shrinks_to_the_room_there_is():
    vessels = (np.array([[-0.014, 0.0, 0.0]]), np.array([[0.014, 0.0, 0.0]]))
    tumour = place_tumour(np.zeros((1, 3)), vessels, 0.014, 0.002, np.random.default_rng(1))
    assert 0.010 < tumour.radius < 0.012
    assert tumour(vessels[0])[0] > 0.0 and tumour(vessels[1])[0] > 0.0


def test_tumour_without_room_is_an_error():
    vessels = (np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(InvalidInputError, match="no room for a tumour"):
        place_tumour(np.array([[0.01, 0.0, 0.0]]), vessels, 0.014, 0.002, np.random.default_rng(1))
