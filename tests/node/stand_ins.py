"""Stand-ins for packages of ROS that are not on PyPI."""

import sys
import types


class Recorder:
    """Stands in for a class of a package that is not on PyPI: remembers how it was made."""

    def __init__(self, *args, **keywords):
        self.args, self.keywords = args, keywords


def stand_in(monkeypatch, name, **members):
    module = module_of(name, **members)
    monkeypatch.setitem(sys.modules, name, module)
    return module


def module_of(name, **members):
    module = types.ModuleType(name)
    vars(module).update(members)
    return module


class TransformException(Exception):
    """The base of all that tf2 raises, as in tf2_py."""


class LookupException(TransformException):
    pass


class ConnectivityException(TransformException):
    pass


class ExtrapolationException(TransformException):
    pass


class InvalidArgumentException(TransformException):
    pass


class Buffer:
    """Stands in for tf2's buffer of two frames: knows what was set, and raises as tf2 does.

    Between two stamps tf2 interpolates; here only their own stamps are known.
    """

    def __init__(self):
        self._known = {}

    def set_transform(self, message, _authority=""):
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        self._frames(message).setdefault("moving", {})[stamp] = message

    def set_transform_static(self, message, _authority=""):
        self._frames(message)["static"] = message

    def _frames(self, message):
        return self._known.setdefault((message.header.frame_id, message.child_frame_id), {})

    def lookup_transform(self, target, source, time):
        for name, frame in (("target_frame", target), ("source_frame", source)):
            if frame.startswith("/"):
                raise InvalidArgumentException(
                    f'Invalid argument "{frame}" passed to lookupTransform argument {name} in tf2 frame_ids'
                    " cannot start with a '/'"
                )
        known = {frame for pair in self._known for frame in pair}
        if target not in known:
            raise LookupException(
                f'"{target}" passed to lookupTransform argument target_frame does not exist.'
            )
        if (target, source) not in self._known:
            raise ConnectivityException(
                f"Could not find a connection between '{target}' and '{source}' because they are not part of the"
                " same tree."
            )
        frames = self._known[target, source]
        if "static" in frames:
            return frames["static"]
        stamps = frames["moving"]
        if time.nanoseconds == 0:
            return stamps[max(stamps)]
        if time.nanoseconds not in stamps:
            where = "future" if time.nanoseconds > max(stamps) else "past"
            raise ExtrapolationException(f"Lookup would require extrapolation into the {where}.")
        return stamps[time.nanoseconds]


TF2 = {
    "Buffer": Buffer,
    "TransformListener": Recorder,
    "TransformException": TransformException,
    "LookupException": LookupException,
    "ConnectivityException": ConnectivityException,
    "ExtrapolationException": ExtrapolationException,
    "InvalidArgumentException": InvalidArgumentException,
}
