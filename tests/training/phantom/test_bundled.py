"""The bundled phantom is what the documentation says it is."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from softtissue_estimator.organ.mesh import enclosed_volume, vertex_areas
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.support.resources import bundled_bag, bundled_organ


@pytest.fixture(scope="module")
def organ():
    return load_organ(bundled_organ())


@pytest.fixture(scope="module")
def clouds():
    """Clouds by topic and stamp: columns as stored."""
    found = {}
    with AnyReader([bundled_bag()]) as reader:
        for connection, stamp, data in reader.messages():
            if connection.msgtype.endswith("PointCloud2"):
                cloud = reader.deserialize(data, connection.msgtype)
                columns = np.asarray(cloud.data).view("<f4").reshape(cloud.width, -1)
                found.setdefault(connection.topic, {})[stamp] = columns.astype(float)
    return found


def test_organ_has_the_size_of_a_liver(organ):
    assert 1.2e-3 < enclosed_volume(organ.surface) < 1.8e-3
    assert 5000 <= len(organ.surface.faces) <= 8000
    size = np.ptp(organ.surface.vertices, axis=0)
    np.testing.assert_allclose(size, [0.22, 0.11, 0.16], atol=0.015)


def test_a_fifth_of_the_surface_is_attached(organ):
    areas = vertex_areas(organ.surface)
    assert areas[organ.attached].sum() / areas.sum() == pytest.approx(0.2, abs=0.005)


def test_structures_lie_inside(organ):
    assert signed_distance(organ.surface, organ.structure_points).max() < -0.002


def test_bag_holds_a_hundred_frames_at_ten_hertz(clouds):
    stamps = np.array(sorted(clouds["/surface_points"]))
    np.testing.assert_array_equal(np.diff(stamps), 100_000_000)
    assert len(stamps) == 100
    assert clouds["/markers_truth"].keys() == clouds["/surface_points"].keys()
    assert clouds["/organ_truth"].keys() <= clouds["/surface_points"].keys()


def test_bag_keeps_its_registration_for_late_comers():
    with AnyReader([bundled_bag()]) as reader:
        offered = {
            c.topic: [qos.durability for qos in c.ext.offered_qos_profiles] for c in reader.connections
        }
    assert offered.pop("/registration") == [QosDurability.TRANSIENT_LOCAL]
    assert [*offered.values()] == [[]] * 3


def test_markers_move_two_to_five_centimetres_at_the_peak(clouds):
    moved = {
        stamp: np.linalg.norm(marker[:, :3] - marker[:, 3:], axis=1)
        for stamp, marker in clouds["/markers_truth"].items()
    }
    peak = max(clouds["/organ_truth"], key=lambda stamp: moved[stamp].mean())
    assert len(moved[peak]) == 6
    assert moved[peak].min() > 0.0195 and moved[peak].max() < 0.0505
    assert moved[peak].mean() > 0.95 * max(m.mean() for m in moved.values())


def test_attached_vertices_stay_where_they_are(organ, clouds):
    surface = slice(len(organ.structure_points), None)
    for positions in clouds["/organ_truth"].values():
        moved = np.linalg.norm(positions[surface] - organ.surface.vertices, axis=1)
        assert np.median(moved[organ.attached]) < 1e-4


def test_bag_is_small():
    assert sum(path.stat().st_size for path in bundled_bag().iterdir()) < 5_000_000
