"""Clouds that wait for their pose: which goes on when."""

from softtissue_estimator.ros.inputs.pose_wait import PoseWait


class Room:
    def __init__(self):
        self.unknown, self.handed_on, self.dropped = set(), [], []
        self.wait = PoseWait(self.unknown.__contains__, self.handed_on.append, self.dropped.append)

    def add(self, stamp, now=0.0):
        self.wait.add(stamp, stamp, now, 0.1)


def test_nothing_waits_whose_pose_is_known():
    room = Room()
    room.add(1)
    assert (room.handed_on, room.wait.waiting) == ([1], 0)


def test_item_goes_on_when_its_pose_comes_or_its_time_is_over():
    room = Room()
    room.unknown |= {1, 2}
    room.add(1)
    room.add(2, now=0.05)
    room.wait.poll(0.09)
    assert room.handed_on == []
    room.wait.poll(0.1)
    assert room.handed_on == [1]
    room.unknown.clear()
    room.wait.poll(0.11)
    assert (room.handed_on, room.wait.waiting) == ([1, 2], 0)


def test_item_that_was_overtaken_is_dropped():
    room = Room()
    room.unknown.add(1)
    room.add(1)
    room.add(2)
    room.wait.poll(0.2)
    assert (room.handed_on, room.dropped) == ([2], [1])


def test_only_so_many_wait():
    room = Room()
    room.unknown |= set(range(100))
    for stamp in range(100):
        room.add(stamp)
    assert room.wait.waiting + len(room.dropped) == 100
    assert room.dropped == list(range(len(room.dropped))) and room.wait.waiting < 50
