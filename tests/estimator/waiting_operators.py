"""Find operators for which a GPU would be waited for, without a GPU."""

from torch.utils._python_dispatch import TorchDispatchMode

# Numbers brought to the host, and sizes that depend on values.
_WAITING = ("_local_scalar_dense", "equal", "is_nonzero", "masked_select", "nonzero")
_FEW = 16  # elements: a tensor made from Python's numbers, whose copy to the device a CUDA graph cannot hold


class WaitingOperators(TorchDispatchMode):
    """Counts operators while it is entered, and keeps the names of those that wait."""

    def __init__(self):
        super().__init__()
        self.count = 0
        self.waiting = set()

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        name = operator.overloadpacket.__name__
        self.count += 1
        made = name == "lift_fresh" and args[0].numel() <= _FEW
        if made or name in _WAITING or name.startswith("unique"):
            self.waiting.add(name)
        return operator(*args, **(kwargs or {}))
