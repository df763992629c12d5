"""What came last of many things, by a key of each."""

from collections import OrderedDict
from typing import TypeVar

KeyT = TypeVar("KeyT")
ItemT = TypeVar("ItemT")


def keep_newest(kept: OrderedDict[KeyT, ItemT], most: int, key: KeyT, item: ItemT) -> None:
    """Add an item as the newest, in the place of one with the same key; the oldest go where there are too many.

    Examples
    --------
    >>> kept = OrderedDict(a=1, b=2)
    >>> keep_newest(kept, 2, "a", 3)
    >>> keep_newest(kept, 2, "c", 4)
    >>> dict(kept)
    {'a': 3, 'c': 4}
    """
    kept[key] = item
    kept.move_to_end(key)
    while len(kept) > most:
        kept.popitem(last=False)
