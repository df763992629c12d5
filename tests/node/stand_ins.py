"""Stand-ins for packages of ROS that are not on PyPI."""

import sys
import types


class Recorder:
    """Stands in for a class of a package that is not on PyPI: remembers how it was made."""

    def __init__(self, *args, **keywords):
        self.args, self.keywords = args, keywords


def stand_in(monkeypatch, name, **members):
    module = types.ModuleType(name)
    vars(module).update(members)
    monkeypatch.setitem(sys.modules, name, module)
    return module
