"""The add-on for Blender and the node for ComfyUI, by the documented interfaces of both."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.forked import python
from PIL import Image

from gamba_warp.formats.ply import load_ply
from gamba_warp.model.checkpoint import load_model

ROOT = Path(__file__).resolve().parents[2]
TOASTER = ROOT / "starter" / "icons" / "scopia-toaster.png"
TINY = ROOT / "starter" / "tiny.safetensors"


def example(name):
    path = ROOT / "docs" / "examples" / f"{name}.py"
    assert path.read_text(encoding="utf-8").count("\n") < 150
    spec = importlib.util.spec_from_file_location(name, path)
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def comfyui(monkeypatch, tmp_path):
    """The node's module in a ComfyUI whose results go into ``tmp_path``, with a small model."""
    paths = ModuleType("folder_paths")
    paths.get_output_directory = lambda: str(tmp_path)
    monkeypatch.setitem(sys.modules, "folder_paths", paths)
    module = example("comfyui_gamba")
    monkeypatch.setattr(module, "shipped_model", lambda: model)
    model = load_model(TINY)
    yield module
    del sys.modules["comfyui_gamba"]


def test_the_node_keeps_the_contract_of_nodes(comfyui):
    assert {*comfyui.NODE_DISPLAY_NAME_MAPPINGS} == {*comfyui.NODE_CLASS_MAPPINGS}
    for kind in comfyui.NODE_CLASS_MAPPINGS.values():
        inputs = kind.INPUT_TYPES()
        assert {*inputs} <= {"required", "optional", "hidden"}
        names = [name for group in inputs.values() for name in group]
        assert all(
            isinstance(given[0], str) for group in inputs.values() for given in group.values()
        )
        run = getattr(kind(), kind.FUNCTION)
        assert run.__code__.co_varnames[1 : run.__code__.co_argcount] == tuple(names)
        assert len(kind.RETURN_TYPES) == len(kind.RETURN_NAMES) and isinstance(kind.CATEGORY, str)


def test_a_batch_becomes_files_and_one_row_of_frames(comfyui, tmp_path):
    rgba = torch.from_numpy(np.array(Image.open(TOASTER))).float() / 255
    assert rgba.shape[2] == 4
    image, mask = rgba[None, ..., :3].repeat(2, 1, 1, 1), 1 - rgba[None, ..., 3]
    kind = comfyui.NODE_CLASS_MAPPINGS["GambaPictureTo3D"]
    defaults = {n: v[1]["default"] for n, v in kind.INPUT_TYPES()["required"].items() if len(v) > 1}
    given = defaults | {"frames": 3, "size": 64, "name": "../a"}
    made = kind().run(image=image, mask=mask, **given)
    text, frames = made["result"]
    assert made["ui"] == {"text": [text]}
    assert [Path(line) for line in text.split("\n")] == sorted(tmp_path.glob("a_0000?.ply"))
    assert frames.shape == (6, 64, 64, 3) and 0 <= frames.min() < 0.9 and frames.max() <= 1
    assert torch.equal(frames[:3], frames[3:])
    # A mask that is the other way round cuts out the rest of the picture.
    other = kind().run(image=image[:1], mask=1 - mask, **given)["result"]
    assert Path(other[0]).name == "a_00003.ply"
    first, third = load_ply(tmp_path / "a_00001.ply"), load_ply(other[0])
    assert first.means.shape != third.means.shape or not torch.equal(first.means, third.means)


@pytest.fixture
def blender(monkeypatch):
    """The add-on in a Blender that records what is registered and imported."""
    names = ("bpy", "bpy.types", "bpy.props", "bpy_extras", "bpy_extras.io_utils")
    bpy, *_, helpers = modules = [ModuleType(name) for name in names]
    for name, module in zip(names, modules, strict=True):
        monkeypatch.setitem(sys.modules, name, module)
    entries, classes, imported = [], [], []
    bpy.types = SimpleNamespace(
        AddonPreferences=type("AddonPreferences", (), {}),
        Operator=type("Operator", (), {}),
        TOPBAR_MT_file_import=entries,
    )
    bpy.props = SimpleNamespace(
        StringProperty=lambda **given: given["default"],
        IntProperty=lambda **given: given["default"],
    )
    bpy.utils = SimpleNamespace(register_class=classes.append, unregister_class=classes.remove)

    def gltf(filepath):
        imported.append((Path(filepath).name, Path(filepath).read_bytes()[:4]))
        return {"FINISHED"}

    bpy.ops = SimpleNamespace(import_scene=SimpleNamespace(gltf=gltf))
    helpers.ImportHelper = type("ImportHelper", (), {})
    module = example("blender_gamba")
    yield SimpleNamespace(module=module, entries=entries, classes=classes, imported=imported)
    del sys.modules["blender_gamba"]


def imports(blender, program, path, **changes):
    """Run the operator on a file; return its result and what it reported."""
    kind = blender.module.ImportGamba
    operator, said = kind(), []
    for name, value in {**kind.__annotations__, **changes}.items():
        setattr(operator, name, value)
    operator.filepath, operator.report = str(path), lambda level, text: said.append((level, text))
    settings = SimpleNamespace(preferences=SimpleNamespace(program=str(program)))
    addons = {"blender_gamba": settings}
    context = SimpleNamespace(preferences=SimpleNamespace(addons=addons))
    return operator.execute(context), said


def test_the_add_on_registers_and_leaves(blender):
    module = blender.module
    assert {"name", "blender", "category", "version"} <= {*module.bl_info}
    module.register()
    assert blender.entries == [module.menu] and module.ImportGamba in blender.classes
    layout = SimpleNamespace(operator=lambda name, text: seen.append(name), prop=None)
    seen: list = []
    module.menu(SimpleNamespace(layout=layout), None)
    assert seen == [module.ImportGamba.bl_idname]
    module.unregister()
    assert not blender.entries and not blender.classes


def program(tmp_path, text):
    path = tmp_path / "gamba"
    path.write_text(f"#!{python()}\n{text}")
    path.chmod(0o755)
    return path


@pytest.mark.slow
def test_a_picture_is_imported_as_a_mesh(blender, tmp_path):
    code = f"""import sys
sys.path.insert(0, {str(ROOT)!r})
from functools import partial
from gamba_warp.cli import main
from gamba_warp.pages import export
small = export.SurfaceOptions(voxels=32, views=12, pixels=64, colors=True)
export.Outputs = partial(export.Outputs, surface=small)
main([*sys.argv[1:-2], "--checkpoint", {str(TINY)!r}, *sys.argv[-2:]])
"""
    made = imports(blender, program(tmp_path, code), TOASTER, texture=64)
    assert made == ({"FINISHED"}, [])
    assert blender.imported == [("scopia-toaster-mesh.glb", b"glTF")]


def test_the_commands_are_those_of_the_program(blender, tmp_path, capsys):
    """Every option is one of the command's own."""
    from gamba_warp.cli import load_command
    from gamba_warp.usage import read_words

    for name, want in (("a.png", "reconstruct"), ("a.PLY", "export"), ("a.spz", "export")):
        words = blender.module.command("gamba", Path("-x") / name, tmp_path, 500, 64)
        assert words[:2] == ["gamba", want] and words[-2:] == ["--", str(Path("-x") / name)]
        assert read_words(words[2:], load_command(want)).quiet


def test_what_fails_is_one_line_and_nothing_is_imported(blender, tmp_path):
    bad = program(
        tmp_path, "import sys\nprint('gamba: a.png: no object', file=sys.stderr)\nexit(2)"
    )
    for run in (bad, tmp_path / "none"):
        result, said = imports(blender, run, tmp_path / "a.png")
        assert result == {"CANCELLED"} and not blender.imported
        assert len(said) == 1 and said[0][0] == {"ERROR"} and "\n" not in said[0][1]
        assert said[0][1].endswith("no object" if run == bad else "No such file or directory")
    silent = program(tmp_path, "")
    assert imports(blender, silent, tmp_path / "a.png")[1] == [({"ERROR"}, "gamba wrote no mesh")]
