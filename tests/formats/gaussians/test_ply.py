import math
import warnings

import numpy as np
import pytest
import torch
from helpers.gaussians import some
from helpers.refusals import refused

from gamba_warp.cameras import Cameras, intrinsics
from gamba_warp.errors import FileWarning
from gamba_warp.formats.gaussians.arrays import rest_names
from gamba_warp.formats.gaussians.spz import save_spz
from gamba_warp.formats.ply import load_ply, save_ply
from gamba_warp.formats.read import read
from gamba_warp.gaussians import SH_C0, Gaussians
from gamba_warp.render import render


def write(path, header, body=b""):
    path.write_bytes("\n".join(["ply", *header, "end_header", ""]).encode() + body)
    return path


PROPERTIES = [
    *["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"],
    *["rot_0", "rot_1", "rot_2", "rot_3"],
]


def header(count, kind="float", properties=PROPERTIES, form="binary_little_endian"):
    return [
        f"format {form} 1.0",
        f"element vertex {count}",
        *(f"property {kind} {name}" for name in properties),
    ]


def test_the_file_is_the_standard_layout_in_another_reader(tmp_path):
    from plyfile import PlyData

    gaussians = some(degree=2)
    save_ply(tmp_path / "a.ply", gaussians, comments=["hello"])
    data = PlyData.read(tmp_path / "a.ply")
    assert data.byte_order == "<" and not data.text and "hello" in data.comments
    vertex = data["vertex"]
    want = ["x", "y", "z", "nx", "ny", "nz", *PROPERTIES[3:6], *rest_names(24), *PROPERTIES[6:]]
    assert [p.name for p in vertex.properties] == want
    for channel, k in np.ndindex(3, 8):  # all of red, then all of green, then all of blue
        rest = gaussians.harmonics[:, k, channel]
        np.testing.assert_array_equal(vertex[f"f_rest_{8 * channel + k}"], rest)
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    np.testing.assert_array_equal(vertex["y"], gaussians.means[:, 1])
    opacity = 1 / (1 + np.exp(-vertex["opacity"]))
    np.testing.assert_allclose(opacity, gaussians.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(vertex["scale_2"]), gaussians.scales[:, 2], rtol=1e-5)
    green = vertex["f_dc_1"] * SH_C0 + 0.5
    np.testing.assert_allclose(green, gaussians.colors[:, 1], atol=1e-6, rtol=0)
    w = gaussians.quats[:, 0] / gaussians.quats.norm(dim=1)
    np.testing.assert_allclose(vertex["rot_0"], w, atol=1e-6)


def test_files_of_other_programs_are_read(tmp_path):
    """Big-endian doubles, another order, a colour out of range, a second element."""
    properties = ["opacity", *PROPERTIES[:3], "nx", "red", *PROPERTIES[3:6], *PROPERTIES[7:]]
    values = np.array([[0, 1, 2, 3, 9, 9, 0, 5, -5, *[math.log(0.5)] * 3, 0, 0, 2, 0]], ">f8")
    lines = [*header(1, "double", properties, "binary_big_endian")]
    lines += ["element extra 1", "property list uchar int things"]
    loaded = load_ply(write(tmp_path / "a.ply", lines, values.tobytes() + b"\0"))
    assert loaded.means.tolist() == [[1, 2, 3]] and loaded.means.dtype == torch.float32
    assert loaded.opacities.tolist() == [0.5]
    assert loaded.colors[0].tolist() == pytest.approx([0.5, 0.5 + 5 * SH_C0, 0.5 - 5 * SH_C0])
    assert loaded.quats.tolist() == [[0, 0, 1, 0]]
    torch.testing.assert_close(loaded.scales, torch.full((1, 3), 0.5))


def test_colours_out_of_range_are_kept_and_cut_below_0_alone(tmp_path):
    """An image of half an opacity has half the light of a colour over 1."""
    colors = torch.tensor([[1.5, 0.5, -0.4]])
    one = Gaussians(torch.zeros(1, 3), None, torch.ones(1, 3), torch.full((1,), 0.5), colors)
    save_ply(tmp_path / "a.ply", one)
    loaded = load_ply(tmp_path / "a.ply")
    torch.testing.assert_close(loaded.colors, colors)
    camera = Cameras(torch.eye(4)[None], intrinsics(5, 5)[None], 5, 5)
    camera.viewmats[0, 2, 3] = 2
    pixel = render(loaded, camera).rgb[0, 2, 2]
    torch.testing.assert_close(pixel, torch.tensor([0.75, 0.25, 0.0]), rtol=0, atol=1e-3)


def test_flat_gaussians_have_a_third_scale(tmp_path):
    """2DGS has two scales."""
    names = [name for name in PROPERTIES if name != "scale_2"]
    values = np.ones((1, len(names)), "<f4")
    loaded = load_ply(write(tmp_path / "a.ply", header(1, properties=names), values.tobytes()))
    assert loaded.scales[0].tolist() == pytest.approx([math.e, math.e, 1e-6])


@pytest.mark.parametrize("far, warned", [(0.0, False), (1e3, False), (3e5, True)])
def test_steps_that_are_coarse_for_the_object_are_named(tmp_path, far, warned):
    made = some()
    made.means += far
    save_ply(tmp_path / "a.ply", made)
    for run in (lambda: load_ply(tmp_path / "a.ply"), lambda: save_spz(tmp_path / "a.spz", made)):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            run()
        # 24 bits of an .spz leave steps of 1/8192 beside 1,000, and 1/16 beside 300,000
        lines = [str(line.message) for line in told if line.category is FileWarning]
        assert bool(lines) == warned, lines
        assert all("have steps of" in line for line in lines)


def test_infinite_logarithms_and_logits_have_a_meaning(tmp_path):
    values = np.ones((3, 14), "<f4")
    values[0, 7:10], values[1, 6], values[2, 6] = -np.inf, np.inf, -np.inf
    loaded = load_ply(write(tmp_path / "a.ply", header(3), values.tobytes()))
    assert loaded.scales[0].tolist() == [0, 0, 0]
    assert loaded.opacities[1:].tolist() == [1, 0]


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize(
    "kind, full", [("uchar", 255), ("ushort", 65535), ("float", 1), ("float", 255), ("int", 255)]
)
def test_red_green_blue_are_colours_where_there_are_no_harmonics(tmp_path, form, kind, full):
    """As nerfstudio's ns-export writes them (uchar), and in each type of meshes."""
    rgb = np.array([[0.2, 0.4, 0.6], [1, 0, 0.8]]) * full
    order, code = ">" if "big" in form else "<", {"uchar": "u1", "ushort": "u2", "int": "i4"}
    names = [*PROPERTIES[:3], *PROPERTIES[6:]]
    lines = [*header(2, properties=names, form=form)]
    lines += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    if form == "ascii":
        text = "\n".join("1 " * len(names) + " ".join(f"{x:g}" for x in row) for row in rgb)
        body = text.encode()
    else:
        types = [("own", f"{order}f4", len(names)), ("rgb", order + code.get(kind, "f4"), 3)]
        body = np.ones(2, types)
        body["rgb"] = rgb.round() if kind in code else rgb
        body = body.tobytes()
    loaded = load_ply(write(tmp_path / "a.ply", lines, body))
    # fifths are whole numbers of 255 and of 65535; float32
    np.testing.assert_allclose(loaded.colors, rgb / full, atol=1e-6)
    assert loaded.means.tolist() == [[1, 1, 1]] * 2 and loaded.degree == 0


def test_properties_that_are_not_read_are_named_and_moments_refused(tmp_path):
    path = tmp_path / "a.ply"
    others = ["nx", "ny", "nz", "red", "green", "blue", *rest_names(9)]
    write(path, header(1, properties=[*PROPERTIES, *others]), np.ones(29, "<f4").tobytes())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(path).shape.num == load_ply(path).num == 1
    write(path, header(1, properties=[*PROPERTIES, "filter_3D"]), np.ones(15, "<f4").tobytes())
    with pytest.warns(FileWarning, match="properties that are not read: filter_3d"):
        load_ply(path)
    for name in ("trbf_center", "motion_0", "omega_3", "rot_r_0", "t", "scale_t", "delta_x_t7"):
        write(path, header(1, properties=[*PROPERTIES, name]), np.ones(15, "<f4").tobytes())
        refused(rf"Gaussians change with time \({name}\)", load_ply, path)


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_lines_may_end_with_cr_alone(tmp_path, form):
    """The first byte of the data is then no line end, also if it is 10."""
    row = np.ones((1, 14), "<f4")
    row.view(np.uint8)[0, 0] = 10
    body = row.tobytes() if form != "ascii" else (" ".join(["1"] * 14) + "\r").encode()
    lines = "\r".join(["ply", *header(1, form=form), "end_header", ""]).encode()
    (tmp_path / "a.ply").write_bytes(lines + body)
    np.testing.assert_allclose(load_ply(tmp_path / "a.ply").means, 1, atol=1e-5)


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_another_element_may_come_first_and_a_comment_may_say_end_header(tmp_path, form):
    first = ["element camera 2", "property uchar id", "property list uchar float lens"]
    lines = [f"format {form} 1.0", "comment before end_header", *first]
    lines += [*header(2)[1:], "obj_info end_header", "comment after"]
    rows = np.ones((2, 14), "<f4")
    rows[:, :3] = [[1, 2, 3], [4, 5, 6]]
    if form == "ascii":
        table = "\n".join(" ".join(f"{x:g}" for x in row) for row in rows)
        body = f"7 2 0.5 0.5\n7 0\n{table}\n".encode()
    else:
        lists = [b"\7\2" + np.ones(2, "<f4").tobytes(), b"\7\0"]
        body = b"".join(lists) + rows.tobytes()
    path = write(tmp_path / "a.ply", lines, body)
    assert load_ply(path).means.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read(path).comments == ["before end_header", "after"]


def test_extremes_stay_finite(tmp_path):
    gaussians = some(3)
    gaussians.opacities = torch.tensor([0.0, 1.0, 0.5])
    gaussians.scales[0] = 0
    save_ply(tmp_path / "a.ply", gaussians)
    loaded = load_ply(tmp_path / "a.ply")
    torch.testing.assert_close(loaded.opacities, gaussians.opacities, atol=2e-6, rtol=0)
    assert (loaded.scales > 0).all()


GOOD = np.ones((2, 14), "<f4").tobytes()
BAD_FILES = {
    "empty": (b"", "not a .ply"),
    "image": (b"\x89PNG\r\n\x1a\n" + bytes(50), "not a .ply"),
    "no end": (b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n", "has no end"),
    "endless": (b"ply\n" + b"comment x\n" * 10000 + b"end_header\n", "has no end"),
    "no format": (["element vertex 2", "property float x"], "format is none"),
    "ascii": (header(2, form="ascii"), "could not convert"),
    "odd format": (header(2, form="binary"), "format is binary"),
    "no vertices": (["format binary_little_endian 1.0"], "no property x, y, z; not Gaussians"),
    "faces alone": ([header(2)[0], "element face 2"], "no property x, y, z; not Gaussians"),
    "half a colour": (
        header(2, properties=[*PROPERTIES[:4], *PROPERTIES[6:-1], "red", "green", "blue"]),
        "no property f_dc_1, f_dc_2",
    ),
    "two channels": (
        header(2, properties=[*PROPERTIES[:3], *PROPERTIES[6:], "nx", "red", "blue"]),
        "no property f_dc_0, f_dc_1, f_dc_2",
    ),
    "negative": (header(-1), "element vertex COUNT"),
    "huge": (header("9" * 5000), "element vertex COUNT"),
    "lies": (header(10**15), "truncated or invalid header, 1000000000000000 vertex take"),
    "no properties": (header(2, properties=[]), "no property x, y, z; not Gaussians"),
    "list": (header(2, "list uchar float"), "no property x, y, z; not Gaussians"),
    "odd type": (header(2, "half"), "'half x' is neither a number"),
    "twice": (header(2, properties=[*PROPERTIES, "x"]), "x occurs twice"),
    "odd element": ([*header(2), "element face many"], "expected 'element face COUNT'"),
    "property first": (["property float x", *header(2)], "a property before any element"),
    "none": (header(0), "no Gaussians"),
    "cloud": (header(2, properties=PROPERTIES[:3]), "no property f_dc_0, f_dc_1, f_dc_2"),
    "no opacity": (header(2, properties=PROPERTIES[:6] + PROPERTIES[7:]), "no property opacity"),
}
ODD = {f"{count} coefficients": count for count in (1, 8, 10, 72)}
for case, count in ODD.items():
    head = header(2, properties=[*PROPERTIES, *rest_names(count)])
    BAD_FILES[case] = head, f"{count} properties f_rest_*"
SIZES = {"cloud": 24, "no opacity": 104, "list": 28}  # bytes of the data, if not those of GOOD
SIZES |= dict.fromkeys(["none", "no vertices", "faces alone", "no properties"], 0)


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_refused_with_the_reason(tmp_path, case):
    content, reason = BAD_FILES[case]
    path = tmp_path / "bad.ply"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        size = SIZES.get(case, len(GOOD) + 8 * ODD.get(case, 0))
        write(path, content, bytes(size) if case == "list" else (9 * GOOD)[:size])
    said = refused(None, load_ply, path)
    assert str(path) in said and reason in said


@pytest.mark.parametrize(
    "columns, value, reason",
    [
        *((1, np.nan, "means that are not finite"), (6, np.nan, "opacities that are not finite")),
        *((8, 200, "scales that are not finite"), (3, -np.inf, "colors that are not finite")),
        *((0, 1e30, r"means over 1e\+18"), (7, 60, "scales over")),
        (slice(10, None), 0, "rotations of length zero"),
    ],
)
def test_values_that_cannot_be_drawn_are_refused(tmp_path, columns, value, reason):
    values = np.ones((3, 14), "<f4")
    values[1, columns] = value
    path = write(tmp_path / "a.ply", header(3), values.tobytes())
    refused(f"1 of 3 Gaussians have {reason}", load_ply, path)


def test_rotations_may_have_any_length(tmp_path):
    """Also such whose squares leave float32's range."""
    rows = np.ones((3, 14), "<f4")
    rows[1, 10:], rows[2, 10:] = 1e30, 1e-30
    loaded = load_ply(write(tmp_path / "a.ply", header(3), rows.tobytes()))
    torch.testing.assert_close(loaded.quats, torch.full((3, 4), 0.5))
