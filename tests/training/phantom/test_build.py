"""A small phantom from seed to bag: coarse meshes, three frames."""

from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

import softtissue_training.phantom.__main__ as command
from softtissue_estimator.errors import InvalidInputError, MeshError
from softtissue_estimator.organ.mesh import enclosed_volume, vertex_areas
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.organs.tetrahedralise import radius_ratio
from softtissue_training.phantom import filled_shape
from softtissue_training.phantom.bag import BagWriter
from softtissue_training.phantom.build import build_phantom, describe
from softtissue_training.phantom.message_writer import START_NS, folder_digest
from softtissue_training.phantom.motion import push_force
from softtissue_training.phantom.sensor import choose_markers, endoscope_pose
from softtissue_training.phantom.spec import PhantomSpec, Push

SPEC = PhantomSpec(
    seed=1,
    surface_spacing=0.012,
    vessel_spacing=0.0028,
    element_size=0.03,
    portal_ends=4,
    hepatic_ends=4,
    frames=3,
    states=2,
    points_per_frame=400,
    push=Push(peak_n=3.2),
    marker_motion=(0.010, 0.050),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("phantom")


@pytest.fixture(scope="module")
def phantom(folder):
    return build_phantom(SPEC, folder)


@pytest.fixture(scope="module")
def organ(phantom, folder):
    return load_organ(folder / "organs" / "phantom_liver")


@pytest.fixture(scope="module")
def messages(phantom, folder):
    """Messages of the bag by topic: (stamp in ns, message)."""
    found = {}
    with AnyReader([folder / "bags" / "phantom"]) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(data, connection.msgtype))
            )
    return found


def values(cloud, *names):
    """Fields of a cloud as float64 columns, found by their names and offsets."""
    offsets = {field.name: field.offset for field in cloud.fields}
    raw = np.asarray(cloud.data).reshape(cloud.width, cloud.point_step)
    columns = [raw[:, offsets[n] : offsets[n] + 4].copy().view("<f4")[:, 0] for n in names]
    return np.stack(columns, axis=1).astype(float)


def displacement(phantom, points, time):
    return phantom.motion.at(phantom.motion.interpolator.weights(points), time)


def seconds(stamp):
    return (stamp - START_NS) * 1e-9


def test_organ_folder_holds_the_anatomy(organ, phantom):
    np.testing.assert_allclose(organ.surface.vertices, phantom.anatomy.surface.vertices, atol=1e-8)
    np.testing.assert_array_equal(organ.attached, phantom.anatomy.attached)
    assert [s.name for s in organ.structures] == ["portal vein", "hepatic veins", "tumour"]
    np.testing.assert_allclose(organ.query_points, phantom.anatomy.query_points, atol=1e-8)


def test_organ_brings_tetrahedra_that_fill_it(organ):
    assert 500 <= len(organ.tetrahedra.nodes) <= 900
    assert organ.tetrahedra.volumes.sum() == pytest.approx(enclosed_volume(organ.surface), rel=0.02)
    assert radius_ratio(organ.tetrahedra.nodes, organ.tetrahedra.tets).min() > 0.1


def test_structures_lie_inside_the_organ(organ):
    for structure in organ.structures:
        assert signed_distance(organ.surface, structure.mesh.vertices).max() < -0.001


@pytest.mark.parametrize("name", ["attached", "visible"])
def test_patch_is_one_piece_of_a_fifth_of_the_surface(phantom, name):
    chosen = getattr(phantom.anatomy, name)
    surface = phantom.anatomy.surface
    areas = vertex_areas(surface)
    assert areas[chosen].sum() / areas.sum() == pytest.approx(0.2, abs=0.005)
    edges = surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = edges[chosen[edges].all(axis=1)]
    graph = csr_array((np.ones(len(edges)), tuple(edges.T)), shape=(len(chosen),) * 2)
    _, label = connected_components(graph, directed=False)
    assert len(np.unique(label[chosen])) == 1


def test_equilibria_are_converged_and_balanced(phantom):
    assert len(phantom.motion.equilibria) == 1
    assert phantom.motion.worst_residual < 1e-8
    assert phantom.motion.worst_imbalance < 1e-7


def test_attached_surface_stays_and_the_pushed_side_follows_the_push(phantom):
    anatomy, push = phantom.anatomy, SPEC.push
    moved = displacement(phantom, anatomy.surface.vertices, phantom.motion.peak_time)
    assert np.linalg.norm(moved[anatomy.attached], axis=1).mean() < 0.002
    pushed = np.argmin(np.linalg.norm(anatomy.surface.vertices - push.point, axis=1))
    direction = np.array(push.direction) / np.linalg.norm(push.direction)
    assert moved[pushed] @ direction > 0.015


def test_markers_are_inside_and_move_as_far_as_wanted(phantom):
    moved = np.linalg.norm(displacement(phantom, phantom.markers, phantom.motion.peak_time), axis=1)
    assert len(moved) == 6
    assert moved.min() > 0.0099 and moved.max() < 0.0501
    depth = -signed_distance(phantom.anatomy.surface, phantom.markers)
    assert depth.min() > 0.007 and np.count_nonzero(depth > 0.018) >= 3
    distance = np.linalg.norm(phantom.markers[:, None] - phantom.markers, axis=2) + np.eye(6)
    assert distance.min() > 0.015


def test_markers_that_cannot_move_so_far_are_an_error(phantom):
    spec = replace(SPEC, marker_motion=(0.5, 0.6))
    with pytest.raises(InvalidInputError, match="expected 6 inner points that move 500 to 600 mm"):
        choose_markers(phantom.anatomy, phantom.motion, spec, np.random.default_rng(0))


def test_frames_come_at_ten_hertz_and_the_registration_before_them(messages):
    expected = START_NS + np.array([200, 300, 400]) * 1_000_000
    for topic in ("/surface_points", "/markers_truth"):
        np.testing.assert_array_equal([stamp for stamp, _ in messages[topic]], expected)
    assert messages["/registration"][0][0] == START_NS
    for stamp, message in messages["/surface_points"] + messages["/registration"]:
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp


def test_clouds_are_the_moved_reference_points_with_a_millimetre_of_noise(messages, phantom):
    registration = messages["/registration"][0][1]
    assert (registration.header.frame_id, registration.child_frame_id) == ("endoscope", "organ")
    q, t = registration.transform.rotation, registration.transform.translation
    turn, shift = Rotation.from_quat([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
    noise = []
    for stamp, cloud in messages["/surface_points"]:
        assert cloud.header.frame_id == "endoscope"
        assert cloud.width == 400
        reference = values(cloud, "ref_x", "ref_y", "ref_z")
        true = reference + displacement(phantom, reference, seconds(stamp))
        noise.append(values(cloud, "x", "y", "z") - (turn.apply(true) + shift))
    noise = np.concatenate(noise)
    np.testing.assert_allclose(noise.std(axis=0), 0.001, rtol=0.1)
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=2e-4)


def test_reference_points_lie_on_the_visible_surface_and_change_from_frame_to_frame(messages, phantom):
    first, second = (values(cloud, "ref_x", "ref_y", "ref_z") for _, cloud in messages["/surface_points"][:2])
    assert np.abs(signed_distance(phantom.anatomy.surface, first)).max() < 1e-6
    seen = phantom.anatomy.surface.vertices[phantom.anatomy.visible]
    assert np.linalg.norm(first[:, None] - seen, axis=2).min(axis=1).max() < 0.012
    assert not (first[:, None] == second).all(axis=2).any()


def test_true_markers_move_with_the_organ(messages, phantom):
    for stamp, cloud in messages["/markers_truth"]:
        assert cloud.header.frame_id == "organ"
        np.testing.assert_array_equal(values(cloud, "ref_x", "ref_y", "ref_z"), phantom.markers)
        moved = phantom.markers + displacement(phantom, phantom.markers, seconds(stamp))
        np.testing.assert_allclose(values(cloud, "x", "y", "z"), moved, atol=1e-7)


def test_true_organ_is_in_the_order_of_the_query_points(messages, phantom, organ):
    stamp, cloud = messages["/organ_truth"][-1]
    assert cloud.header.frame_id == "organ"
    expected = organ.query_points + displacement(phantom, organ.query_points, seconds(stamp))
    np.testing.assert_allclose(values(cloud, "x", "y", "z"), expected, atol=1e-6)


def test_endoscope_looks_at_its_target():
    target = np.array([-0.03, -0.03, 0.01])
    pose = endoscope_pose(target)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    seen = pose.outer(target[None])[0]
    np.testing.assert_allclose(seen[:2], 0.0, atol=1e-12)
    assert seen[2] > 0.1
    # What is nearer to the head is further up in the image, whose y axis points down.
    assert pose.outer(target[None] + [0.0, 0.0, 0.01])[0, 1] < 0.0


def test_push_rises_from_nothing_and_is_half_released():
    push = Push()
    np.testing.assert_allclose(push_force(push, 0.0), 0.0)
    assert np.linalg.norm(push_force(push, 0.6)) == pytest.approx(push.peak_n, rel=0.05)
    assert np.linalg.norm(push_force(push, 1.0)) == pytest.approx(0.45 * push.peak_n)
    across = [push_force(push, phase) @ np.array(push.sway) for phase in (0.375, 0.525)]
    straight = push_force(push, 0.6) @ np.array(push.sway)
    assert across[0] > straight > across[1]


def test_same_seed_gives_the_same_bytes_and_the_command_says_so(
    phantom, folder, tmp_path, monkeypatch, capsys
):
    small = type("SmallSpec", (), {"__new__": lambda cls: SPEC, "element_size": SPEC.element_size})
    monkeypatch.setattr(command, "PhantomSpec", small)
    assert command.main(["--seed", "1", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert describe(phantom, SPEC) in printed
    for part in ("organs", "bags"):
        assert folder_digest(folder / part) == folder_digest(tmp_path / part)
        assert folder_digest(tmp_path / part) in printed


def test_folder_that_is_no_bag_is_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InvalidInputError, match="expected a new folder or an old bag"):
        BagWriter(tmp_path)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize("setting", [{"frames": 0}, {"points_per_frame": 0}, {"markers": 0}, {"states": 1}])
def test_settings_without_sense_are_refused(setting):
    with pytest.raises(InvalidInputError, match="at least"):
        PhantomSpec(**setting)


def test_body_is_filled_with_smaller_elements_where_some_would_be_flat(phantom, monkeypatch):
    tried = []

    def fill(surface, size):
        tried.append(size)
        if len(tried) < 2:
            raise MeshError("too flat")
        return "mesh"

    monkeypatch.setattr(filled_shape, "tetrahedralise", fill)
    assert filled_shape.fill(phantom.anatomy.shape, 0.03) == "mesh"
    np.testing.assert_allclose(tried, [0.036, 0.96 * 0.036])


def test_body_that_cannot_be_filled_is_an_error(phantom, monkeypatch):
    def fill(surface, size):
        raise MeshError("too flat")

    monkeypatch.setattr(filled_shape, "tetrahedralise", fill)
    with pytest.raises(MeshError, match="too flat"):
        filled_shape.fill(phantom.anatomy.shape, 0.03)
