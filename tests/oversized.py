# SPDX-License-Identifier: MIT
"""Small files that expand enormously, each read by the command that a user would use.

    python -m tests.oversized mitsuba_diamond

writes one of ``FILES``, runs its command, and prints time, peak memory and output.
"""

from __future__ import annotations

import base64
import io
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from tests.conftest import REPOSITORY
from tests.datagen.small_library import box, with_uv

MAX_SECONDS = 10.0
MAX_BYTES = 1 << 30
_HEAD = '<scene version="3.0.0">'
_SHAPE = '<shape type="rectangle">{}</shape>'


@dataclass(frozen=True)
class Reading:
    """Result of a command: exit code, output, processor seconds and peak memory."""

    code: int
    text: str
    seconds: float
    peak_bytes: int


def scene(path: Path, *body: str) -> Path:
    """Write a Mitsuba scene with the elements ``body``; return its path."""
    path.write_text(f"{_HEAD}{''.join(body)}</scene>")
    return path


def _diamond(folder: Path) -> Path:
    """41 BSDFs, each of which refers to the next one twice: 2^40 paths through the graph."""
    bsdfs = ['<bsdf type="diffuse" id="b40"/>']
    bsdfs += [
        f'<bsdf type="blendbsdf" id="b{k}"><float name="weight" value="0.5"/>'
        f'<ref id="b{k + 1}"/><ref id="b{k + 1}"/></bsdf>'
        for k in reversed(range(40))
    ]
    return scene(folder / "scene.xml", *bsdfs, _SHAPE.format('<ref id="b0"/>'))


def _doubling(folder: Path) -> Path:
    """Thirty ``default`` elements, each of which doubles the previous one: 8 GB of text."""
    lines = ['<default name="a0" value="12345678"/>']
    lines += [f'<default name="a{k + 1}" value="$a{k}$a{k}"/>' for k in range(30)]
    return scene(folder / "scene.xml", *lines, _SHAPE.format('<string name="filename" value="$a30"/>'))


def _includes(folder: Path) -> Path:
    """Includes that fan out by four over fifteen levels: 4^15 files to read."""
    for level in range(1, 15):
        scene(folder / f"l{level}.xml", f'<include filename="l{level + 1}.xml"/>' * 4)
    scene(folder / "l15.xml", _SHAPE.format(""))
    return scene(folder / "scene.xml", '<include filename="l1.xml"/>' * 4)


def _instances(folder: Path) -> Path:
    """A group of 200 shapes, placed 5,000 times: a million parts."""
    group = f'<shape type="shapegroup" id="g">{_SHAPE.format("") * 200}</shape>'
    return scene(folder / "scene.xml", group, '<shape type="instance"><ref id="g"/></shape>' * 5000)


def _references(folder: Path) -> Path:
    """A chain of 3,000 references."""
    bsdfs = ['<bsdf type="diffuse" id="b0"/>']
    bsdfs += [f'<bsdf type="twosided" id="b{k}"><ref id="b{k - 1}"/></bsdf>' for k in range(1, 3001)]
    return scene(folder / "scene.xml", *bsdfs, _SHAPE.format('<ref id="b3000"/>'))


def _nested(folder: Path) -> Path:
    """20,000 elements, each nested in the previous one."""
    chain = '<bsdf type="twosided">' * 20_000 + "</bsdf>" * 20_000
    return scene(folder / "scene.xml", _SHAPE.format(chain))


def gltf(folder: Path, changes: dict | None = None) -> Path:
    """Write a glTF file of one square with changed top-level entries."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4").tobytes()
    data = positions + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [
            {
                "byteLength": len(data),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
            }
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        ],
    }
    path = folder / "model.gltf"
    path.write_text(json.dumps({**document, **(changes or {})}))
    return path


def _gltf_nodes(folder: Path) -> Path:
    """60,000 nodes that instance the same mesh."""
    return gltf(folder, {"nodes": [{"mesh": 0}] * 60_000, "scenes": [{"nodes": list(range(60_000))}]})


def _gltf_primitives(folder: Path) -> Path:
    """20,000 primitives that share their accessors."""
    return gltf(
        folder, {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * 20_000}]}
    )


def _gltf_chain(folder: Path) -> Path:
    """A chain of 50,000 nodes."""
    chain = [{"children": [k + 1]} for k in range(49_999)]
    return gltf(folder, {"nodes": [*chain, {"mesh": 0}]})


def _gltf_matrix(folder: Path) -> Path:
    """A node matrix of three numbers."""
    return gltf(folder, {"nodes": [{"mesh": 0, "matrix": [1, 0, 0]}]})


def _gltf_sparse(folder: Path) -> Path:
    """A sparse accessor whose index is negative."""
    data = np.array([-9], "<i1").tobytes() + bytes(3) + np.zeros(3, "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    sparse = {
        "count": 1,
        "indices": {"bufferView": 0, "componentType": 5120},
        "values": {"bufferView": 1},
    }
    views = [{"buffer": 0, "byteLength": 4}, {"buffer": 0, "byteOffset": 4, "byteLength": 12}]
    accessor = {"componentType": 5126, "type": "VEC3", "count": 6, "sparse": sparse}
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    return gltf(
        folder,
        {"buffers": [{"byteLength": len(data), "uri": uri}], "bufferViews": views, "accessors": [accessor],
         "meshes": meshes},
    )  # fmt: skip


def furniture(path: Path, pieces: list[str], members: dict[str, bytes]) -> Path:
    """Write a Sweet Home 3D library with one piece per name in ``pieces`` and the files ``members``."""
    lines = ["id=strangers#1", "provider=a stranger"]
    for number, model in enumerate(pieces, start=1):
        lines += [
            f"{key}#{number}={value}"
            for key, value in (
                ("id", f"piece{number}"), ("name", f"Piece {number}"), ("model", f"/{model}"),
                ("width", "50"), ("depth", "50"), ("height", "50"), ("license", "CC0"),
            )
        ]  # fmt: skip
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join(lines))
        for name, content in members.items():
            archive.writestr(name, content)
    path.write_bytes(stream.getvalue())
    return path


def _furniture(folder: Path) -> Path:
    """A library of 0.2 MB that expands to 167 MB, in members of 56 MB."""
    model = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    filler = model + b"v 0 0 0\n" * ((55_666_667 - len(model)) // 8)
    return furniture(
        folder / "bomb.sh3f",
        ["a/a.obj", "b/b.obj", "c/c.obj"],
        {"a/a.obj": filler, "b/b.obj": filler, "c/c.obj": filler},
    )


def capture_folder(folder: Path) -> None:
    """Create a capture folder with a photograph and a mesh but without cameras."""
    pixels = np.random.default_rng(0).integers(0, 256, (8, 12, 3)).astype(np.uint8)
    (folder / "images").mkdir(exist_ok=True)
    (folder / "images" / "a.png").write_bytes(encode_png(pixels))
    (folder / "room.ply").write_bytes(encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1]))))


def _frames(folder: Path) -> Path:
    """transforms.json with 300,000 frames."""
    capture_folder(folder)
    frame = json.dumps({"file_path": "images/a.png", "transform_matrix": np.eye(4, dtype=int).tolist()})
    text = ",".join([frame] * 300_000)
    (folder / "transforms.json").write_text(f'{{"fl_x":10,"w":12,"h":8,"frames":[{text}]}}')
    return folder


def _empty_frames(folder: Path) -> Path:
    """300,000 empty frames in 0.9 MB."""
    capture_folder(folder)
    (folder / "transforms.json").write_text('{"frames":[' + ",".join(["{}"] * 300_000) + "]}")
    return folder


IMPORT = ("-m", "datagen", "import", "{}", "--library", "{out}", "--license", "CC0-1.0")
CHECK = ("-m", "model.cli", "check", "{}", "--quiet")
FILES: dict[str, tuple[Callable[[Path], Path], tuple[str, ...]]] = {
    "mitsuba_diamond": (_diamond, IMPORT),
    "mitsuba_doubling": (_doubling, IMPORT),
    "mitsuba_includes": (_includes, IMPORT),
    "mitsuba_instances": (_instances, IMPORT),
    "mitsuba_references": (_references, IMPORT),
    "mitsuba_nested": (_nested, IMPORT),
    "gltf_nodes": (_gltf_nodes, IMPORT),
    "gltf_primitives": (_gltf_primitives, IMPORT),
    "gltf_chain": (_gltf_chain, IMPORT),
    "gltf_matrix": (_gltf_matrix, IMPORT),
    "gltf_sparse": (_gltf_sparse, IMPORT),
    "sweet_home": (_furniture, IMPORT),
    "transforms_frames": (_frames, CHECK),
    "transforms_empty_frames": (_empty_frames, CHECK),
}
"""Writer of each hostile file, and the command that reads the file."""


def run(
    name: str, folder: Path, environment: dict[str, str] | None = None, most_seconds: float = 60.0
) -> Reading:
    """Write a file into ``folder`` and run its command in a separate process."""
    write, command = FILES[name]
    path = write(folder)
    out = folder.parent / f"{folder.name}-out"
    arguments = [word.format(path, out=out) for word in command]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (4 << 30, 4 << 30))
        resource.setrlimit(resource.RLIMIT_CPU, (int(most_seconds), int(most_seconds) + 1))

    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=REPOSITORY,
            env={**os.environ, **(environment or {})},
            stdout=log,
            stderr=subprocess.STDOUT,
            preexec_fn=limit,
        )
        deadline, peak_bytes = time.monotonic() + 4 * most_seconds, 0
        try:
            while True:
                peak_bytes = _peak_bytes(process.pid) or peak_bytes
                done, status, usage = os.wait4(process.pid, os.WNOHANG)
                if done:
                    break
                if time.monotonic() > deadline:
                    process.kill()
                time.sleep(0.02)
        finally:
            process.returncode = 0  # already waited for above
        log.seek(0)
        text = log.read().decode("utf-8", "replace")
    code = os.waitstatus_to_exitcode(status)
    return Reading(code, text, usage.ru_utime + usage.ru_stime, peak_bytes or usage.ru_maxrss * 1024)


def _peak_bytes(pid: int) -> int:
    """Return the peak resident bytes of a process since its start, or 0 if unknown; those of ``wait4`` would
    include the memory of its parent at the fork."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    found = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return 1024 * int(found[0]) if found else 0


def main() -> None:
    """Write one of the files, read it, and print the result."""
    for name in sys.argv[1:] or FILES:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "case"
            folder.mkdir()
            reading = run(name, folder)
        last = reading.text.strip().splitlines()[-1:] or [""]
        print(
            f"{name}: {reading.seconds:.1f} s, {reading.peak_bytes / 2**20:.0f} MB, code {reading.code}: "
            f"{last[0][:300]}",
            flush=True,
        )


if __name__ == "__main__":
    main()
