"""C++ headers as kernels."""

import torch
import warp as wp

from gamba_warp.kernels.runtime.launch import parallel_launch
from gamba_warp.kernels.runtime.native import constants, native, native_kernel


def test_a_function_of_a_header_is_a_kernel_and_its_text_decides_the_module(tmp_path):
    path, part = tmp_path / "scale.h", tmp_path / "part.h"
    path.write_text(
        '#include "part.h"\n#include "part.h"\n'  # once, as it defines a function
        "template<class Config, class In, class Out>\n"
        "static void scale(int task, const In& in, const Out& out) {\n"
        "    out.y.data[task] = times<Config>(in.x.data[task]) + in.shift;\n"
        "}\n"
    )
    part.write_text(
        "template<class Config> static float times(float x) {\n"
        "    return Config::ODD ? x * Config::HALF : x * Config::TERM;\n"
        "}\n"
    )

    def kernel():
        header = native(path) + constants("Config", TERM=2, HALF=0.5, ODD=True)
        inputs = {"x_in": wp.array(dtype=float), "shift": float}
        call = "scale<Config>"
        outputs = {"y_out": wp.array(dtype=float)}
        return native_kernel("scale", call, inputs, outputs, header, grouped=True)

    first, x, y = kernel(), torch.tensor([1.0, 2.0, 4.0]), torch.zeros(3)
    parallel_launch(first, 3, [x, 0.25], [y], threads=2)
    assert y.tolist() == [0.75, 1.25, 2.25]
    assert kernel().module.get_module_hash() == first.module.get_module_hash()
    part.write_text(part.read_text().replace("HALF", "TERM"))
    assert kernel().module.get_module_hash() != first.module.get_module_hash()
