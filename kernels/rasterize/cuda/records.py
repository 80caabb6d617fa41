"""One record for each Gaussian of a view: what the compositor reads of it, 16 bytes at a time."""

from pathlib import Path

import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.native import constants, native, native_kernel
from ...runtime.views import as_struct, struct, struct_of
from ..tiles import SLACK, SLACK_ABS, RasterParams, Splats2D, record_size

_CONFIG = constants("Config", SLACK=SLACK, SLACK_ABS=SLACK_ABS)
_record = native_kernel(
    "record",
    "gamba::raster::record<Config>",
    inputs={"params": RasterParams, "splats": struct_of(Splats2D)},
    outputs={"records": wp.array2d[wp.float32]},
    header=_CONFIG + native(Path(__file__).with_name("records.h")),
)


@struct
class Gaussians:
    """Gaussians to composite, in view-major order; ``record.h`` has what a record is."""

    records: wp.array2d[wp.float32]
    channels: int
    first: int  # the first channel of this launch


def make_records(splats: Splats2D, params: RasterParams) -> Tensor:
    """Records ``[I * N, record_size(C)]`` of all Gaussians."""
    opacities, colors = splats.view_opacities, splats.colors
    records = colors.new_empty(opacities.numel(), record_size(colors.shape[1]))
    launch(_record, len(records), [params, as_struct(splats)], [records], colors.device)
    return records
