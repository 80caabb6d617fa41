"""Views of tensors: their cache of descriptors, several threads; launches on a simulated GPU."""

import pytest
import torch
import warp as wp
from ptx.simulated import is_simulated, simulated

from gamba_warp.kernels.runtime import gpu, views
from gamba_warp.kernels.runtime.launch import cuda_launch, launch
from gamba_warp.kernels.runtime.views import StructValue, struct, view


class _Cleared(dict):
    """A cache that another thread clears as soon as something is put into it."""

    def __setitem__(self, key, value):
        super().__setitem__(key, value)
        self.clear()


def test_a_cache_that_another_thread_clears(monkeypatch):
    monkeypatch.setattr(views, "_descriptors", _Cleared())
    x = torch.arange(6.0).view(2, 3)
    made = view(x)
    assert made.data == x.data_ptr() and tuple(made.shape)[:2] == (2, 3)


@struct
class _Points:
    places: wp.array[wp.vec3]
    rows: wp.array2d[wp.float32]
    absent: wp.array[wp.int32]
    count: int


@wp.kernel(enable_backward=False, module="unique")
def _row_sums(points: _Points, out: wp.array[float]):
    i = wp.tid()
    out[i] = points.places[i][2] + points.rows[i, 1] + float(points.count)
    if points.absent:
        out[i] = 0.0


def test_a_struct_of_arrays_for_a_launch():
    """Leading dimensions count as one, None is no array, and what does not fit is refused."""
    for number in (7, 7, 8):  # other memory of the same shapes, and then another number
        places, rows, out = torch.randn(2, 3, 3), torch.randn(2, 3, 4), torch.zeros(6)
        points = StructValue(_Points, places, rows, None, number)
        wp.launch(_row_sums, 6, [points, view(out)], device="cpu")
        assert torch.equal(out, (places[..., 2] + rows[..., 1] + number).flatten())
    with pytest.raises(TypeError, match="int64"):
        StructValue(_Points, places.long(), rows, None, 7)
    with pytest.raises(ValueError, match="longer"):
        StructValue(_Points, places, rows)


@wp.kernel(enable_backward=False, module="unique")
def _never(x_out: wp.array[float]):
    x_out[wp.tid()] = 1.0


def test_a_simulated_gpu_gets_launches_and_ends_with_its_block():
    told, device, x = [], torch.device("cuda"), torch.zeros(6)
    with pytest.raises(KeyError), simulated(lambda *launch: told.append(launch), 77):
        assert gpu.multiprocessors_of(device) == gpu.multiprocessors_of(x.device) == 77
        assert is_simulated() and gpu.kind_of(x.device) == "cuda"
        cuda_launch(_never, 6, [], [x], device=device, block_dim=32)
        launch(_never, (2, 3), [], [x], x.device)
        raise KeyError
    (one, *_, block, _), (_, dim, arguments, _, _) = told
    assert one is _never and block == 32 and dim == (2, 3) and arguments[0] == 0
    assert arguments[1].data == x.data_ptr() and not x.any()
    assert not is_simulated() and gpu.kind_of(x.device) == "cpu"
