"""A plain kernel, inputs of the convolution, and a recorder of torch's operators."""

import torch
import warp as wp
from torch._library.custom_ops import OPDEFS
from torch.utils._python_dispatch import TorchDispatchMode


@wp.kernel(enable_backward=False, module="unique")
def plain_kernel(x_in: wp.array[float], x_out: wp.array[float]):
    i = wp.tid()
    x_out[i] = 2.0 * x_in[i]


def conv_inputs(batch, length, channels, width, dtype=torch.float32):
    """All four tensors, standard normal; the weight and the bias are float32."""
    return {
        "x": torch.randn(batch, length, channels).to(dtype),
        "weight": torch.randn(channels, width),
        "bias": torch.randn(channels),
        "initial_state": torch.randn(batch, width - 1, channels).to(dtype),
    }


# Operators that wait for the GPU, or make a tensor on the host.
WAITS = {
    "aten::item", "aten::_local_scalar_dense", "aten::nonzero", "aten::is_nonzero", "aten::equal",
    "aten::masked_select", "aten::_unique2", "aten::unique_dim", "aten::bincount",
    "aten::linalg_inv_ex", "aten::_linalg_check_errors", "aten::linalg_solve_ex",
    "aten::lift_fresh", "aten::repeat_interleave.Tensor",
}  # fmt: skip
# Views that are none to torch, and notes for its profiler.
VIEWS = {
    "aten::_unsafe_view", "aten::detach", "prim::device", "profiler::_record_function_enter_new",
    "profiler::_record_function_exit",
}  # fmt: skip
INDEXING = {"aten::index.Tensor", "aten::index_put", "aten::index_put_"}


class Watch(TorchDispatchMode):
    """Records operators that a CUDA graph cannot capture, also inside our own operators.

    Tensors on the CPU show operators that read numbers back; those of a dry run also show copies
    between devices.

    Attributes:
        found: the recorded operators.
        names: names of all operators.
        computed: number of calls of operators that are no views; ours count once.
    """

    def __init__(self):
        super().__init__()
        self.found, self.names, self.computed = [], set(), 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        body = OPDEFS.get(function.name()) if function.namespace == "gamba_warp" else None
        if body is not None:
            self.names.add(function.name())
            before = self.computed
            with self:
                out = body._init_fn(*args, **(kwargs or {}))
            self.computed = before + 1
            return out
        name = function.name()
        self.names.add(name)
        self.computed += not (function.is_view or name in VIEWS)
        if name in WAITS:
            self.found.append(name)
        out = function(*args, **(kwargs or {}))
        leaves = torch.utils._pytree.tree_leaves((args, kwargs, out))
        tensors = [x for x in leaves if isinstance(x, torch.Tensor)]
        if name in INDEXING and any(x.dtype == torch.bool for x in tensors[1:-1]):
            self.found.append(f"{name} by a mask")
        devices = {x.device.type for x in tensors if x.dim()}
        if len(devices) > 1 and not self._later(name, args, kwargs or {}):
            self.found.append(f"{name} between {sorted(devices)}")
        return out

    @staticmethod
    def _later(name, args, kwargs):
        """True for an asynchronous copy."""
        return name == "aten::copy_" and (kwargs.get("non_blocking") or args[2:3] == (True,))
