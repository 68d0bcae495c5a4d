# SPDX-License-Identifier: GPL-3.0-or-later
"""Screenshots of the add-on in a real window, under Xvfb: ``python -m tests.blender_addon.window OUT``.

``--blender PROGRAM`` takes them in that program; one older than the add-on requires shows the refusal. The
default is pip's bpy, which always runs in background mode: in the pinned wheel (bpy 4.5.15, x86-64), this
module patches the start-up instruction that enables background mode, imports bpy, and runs Blender's main
loop. Requires Xvfb, ImageMagick's ``import`` and, for an old Blender, xdotool.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

DISPLAY, SIZE = ":97", "1280x1080"
REPOSITORY = Path(__file__).resolve().parents[2]
_INSTRUCTION = bytes.fromhex("c683210c000001")  # movb $1, G.background
_OFFSET, _MAIN_LOOP = 0xD5A637, 0x181B410  # offsets of the instruction and of WM_main
_PAGE = 4096


def main(out: Path, blender: str | None = None) -> int:
    """Start Xvfb and run this module in it, by Python or ``blender``; return the child's exit code."""
    out.mkdir(parents=True, exist_ok=True)
    server = subprocess.Popen(["Xvfb", DISPLAY, "-screen", "0", f"{SIZE}x24"], stderr=subprocess.DEVNULL)
    try:
        for _ in range(100):
            if Path(f"/tmp/.X11-unix/X{DISPLAY[1:]}").exists():
                break
            time.sleep(0.05)
        environment = {**os.environ, "DISPLAY": DISPLAY, "LIBGL_ALWAYS_SOFTWARE": "1"}
        child = [sys.executable, "-m", "tests.blender_addon.window", str(out), "--inside"]
        if blender:
            size = ["-p", "0", "0", *SIZE.split("x")]
            start = f"import sys; sys.path.insert(0, {str(REPOSITORY)!r}); "
            start += (
                f"from tests.blender_addon import window; window.drive(window.Path({str(out.resolve())!r}))"
            )
            child = [blender, "--factory-startup", *size, "--python-exit-code", "1", "--python-expr", start]
        return subprocess.run(child, env=environment, timeout=300, check=False).returncode
    finally:
        server.terminate()
        server.wait()


def import_with_window() -> tuple[Any, int]:
    """Import bpy such that it can open a window; return it and the base address of its shared library."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        raise RuntimeError("bpy is not installed")
    ctypes.CDLL(spec.origin, mode=os.RTLD_NOW | os.RTLD_LOCAL)
    lines = [line for line in Path("/proc/self/maps").read_text().splitlines() if spec.origin in line]
    base = int(lines[0].split("-")[0], 16)
    address = base + _OFFSET
    if ctypes.string_at(address, len(_INSTRUCTION)) != _INSTRUCTION:
        raise RuntimeError("this is not the wheel of bpy that the trick was made for (4.5.15, x86-64)")
    start = address // _PAGE * _PAGE
    protect = ctypes.CDLL(None).mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if protect(start, 2 * _PAGE, 7) != 0:
        raise RuntimeError("the code page cannot be made writable")
    ctypes.memset(address + len(_INSTRUCTION) - 1, 0, 1)
    import bpy

    return bpy, base


def inside(out: Path) -> None:
    """Open the window, drive it by timers and save the pictures; runs in the virtual display."""
    bpy, base = import_with_window()
    drive(out.resolve())
    loop = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(base + _MAIN_LOOP)
    loop(bpy.context.as_pointer())


def drive(out: Path) -> None:
    """Enable the add-on and start the script by a timer; the process exits at its end."""
    import bpy

    import blender_addon
    from blender_addon.version import fault_of_version

    os.chdir(out)
    script = (_refused if fault_of_version() else _script)(bpy, out)

    def tick() -> float | None:
        try:
            return next(script)
        except StopIteration:
            os._exit(0)
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
            os._exit(1)

    blender_addon.register()
    bpy.app.timers.register(tick, first_interval=1.0)


def _picture(path: Path) -> None:
    subprocess.run(["import", "-window", "root", str(path)], check=True)


def _view(bpy: Any) -> dict[str, Any]:
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    region = next(r for r in area.regions if r.type == "WINDOW")
    return {"window": window, "area": area, "region": region}


def _script(bpy: Any, out: Path) -> Any:
    """Run the steps in the window; yield the seconds to wait after each."""
    bpy.context.preferences.view.show_splash = False
    cube = bpy.data.objects.get("Cube")
    glass = bpy.data.materials.new("Glass")
    glass.use_nodes = True
    glass.node_tree.nodes["Principled BSDF"].inputs["Transmission Weight"].default_value = 1
    glass.node_tree.nodes["Principled BSDF"].inputs["Sheen Weight"].default_value = 0.5
    glass["sm_class"] = "glass"
    cube.data.materials.clear()
    cube.data.materials.append(glass)
    cube["sm_role"], cube["sm_category"] = "object", "paperweight"
    view = _view(bpy)
    view["area"].spaces.active.show_region_ui = True
    view["area"].spaces.active.shading.type = "SOLID"
    yield 2.0
    panel = next(r for r in view["area"].regions if r.type == "UI")
    panel.active_panel_category = "Materials"
    chosen = bpy.context.window_manager.scene_materials
    chosen.kind, chosen.max_texture, chosen.directory = "object", "256", "packages"
    with bpy.context.temp_override(**view):
        bpy.ops.scene_materials.check()
    assert any(p.severity == "error" for p in chosen.problems)
    view["area"].tag_redraw()
    yield 2.0
    _picture(out / "problems.png")
    chosen.problems.clear()
    shader = glass.node_tree.nodes["Principled BSDF"]
    shader.inputs["Transmission Weight"].default_value = 0
    noise, coordinates = (glass.node_tree.nodes.new(f"ShaderNode{n}") for n in ("TexNoise", "TexCoord"))
    glass.node_tree.links.new(coordinates.outputs["Object"], noise.inputs["Vector"])
    glass.node_tree.links.new(noise.outputs["Color"], shader.inputs["Base Color"])
    cube["sm_license"] = "CC0-1.0"
    cube.data.uv_layers.remove(cube.data.uv_layers[0])  # so the export has to unwrap it
    noise.inputs["Detail"].default_value = 0
    yield 0.5
    with bpy.context.temp_override(**view):
        bpy.ops.scene_materials.export("INVOKE_DEFAULT", directory="packages")
    for _ in range(200):
        if "packages" in chosen.status:
            break
        yield 0.1
    assert chosen.status.startswith("1 packages"), chosen.status
    assert (out / "packages" / "cube" / "asset.json").is_file()
    assert cube.name in bpy.context.view_layer.objects
    yield 1.0
    _picture(out / "exported.png")
    print("done")


def _refused(bpy: Any, out: Path) -> Any:
    """Run the steps in an old Blender, whose panel shows the refusal; yield as :func:`_script` does."""
    bpy.context.preferences.view.show_splash = False
    cube = bpy.data.objects["Cube"]
    cube["sm_role"], cube["sm_category"], cube["sm_license"] = "object", "paperweight", "CC0-1.0"
    view = _view(bpy)
    view["area"].spaces.active.show_region_ui = True
    yield 2.0
    # Blender 3.4 ignores show_splash and lacks `active_panel_category`: click both with the mouse.
    for x, y in ((500, 950), (1043, 252)):
        subprocess.run(["xdotool", "mousemove", str(x), str(y), "click", "1"], check=True)
        yield 2.0
    chosen = bpy.context.window_manager.scene_materials
    with bpy.context.temp_override(**view):
        bpy.ops.scene_materials.check()
    assert [p.severity for p in chosen.problems] == ["error"]
    view["area"].tag_redraw()
    yield 3.0
    _picture(out / "refused.png")
    print("refused")


if __name__ == "__main__":
    if "--inside" in sys.argv:
        inside(Path(sys.argv[1]))
    else:
        program = sys.argv[sys.argv.index("--blender") + 1] if "--blender" in sys.argv else None
        sys.exit(main(Path(sys.argv[1]), program))
