"""C++ files as the text of native functions."""

import torch
import warp as wp

from gamba_warp.kernels.runtime.launch import parallel_launch
from gamba_warp.kernels.runtime.native import constants, native, native_kernel


def made(path):
    @wp.func_native(native(path, TERM=2, HALF=0.5, ODD=True))
    def sum_of(n: int) -> float: ...

    @wp.kernel(enable_backward=False, module="unique")
    def kernel(offset: wp.int32, out: wp.array(dtype=float)):
        i = offset + wp.tid()
        out[i] = sum_of(i)

    return kernel


def test_a_file_is_compiled_with_its_macros_and_its_text_decides_the_module(tmp_path):
    path, part = tmp_path / "sum.inl", tmp_path / "part.h"
    path.write_text(
        'float sum = HALF;\n#include "part.h"\nif constexpr (ODD) sum += 1;\nreturn sum;\n'
    )
    part.write_text("for (int i = 0; i < n; ++i) sum += TERM;\n")
    kernel, out = made(path), torch.zeros(3)
    parallel_launch(kernel, 3, [], [out])
    assert out.tolist() == [1.5, 3.5, 5.5]
    assert made(path).module.get_module_hash() == kernel.module.get_module_hash()
    part.write_text(part.read_text() + "sum += 1;\n")
    assert made(path).module.get_module_hash() != kernel.module.get_module_hash()


def test_macros_end_with_their_file(tmp_path):
    path = tmp_path / "one.inl"
    path.write_text("return ONE;\n")
    assert native(path, ONE=1).split() == "#define ONE 1 return ONE; #undef ONE".split()


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
