"""The newest of many things."""

from collections import OrderedDict

from softtissue_estimator.support.newest import keep_newest


def test_the_oldest_go_and_what_comes_again_is_the_newest():
    kept = OrderedDict(a=1, b=2)
    keep_newest(kept, 2, "a", 3)
    assert list(kept.items()) == [("b", 2), ("a", 3)]
    keep_newest(kept, 2, "c", 4)
    assert list(kept.items()) == [("a", 3), ("c", 4)]
