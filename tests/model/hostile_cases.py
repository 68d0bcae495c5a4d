# SPDX-License-Identifier: MIT
"""Hostile input of `materials`: captures in every format, meshes, photographs, shards, weights."""

from __future__ import annotations

import io
import json
import random
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from datagen.formats.asset import AssetCamera, EnvironmentAsset, Part, Provenance, SlotMaterial
from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.capture import CaptureFile, MeshRecord, PhotographRecord
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.package import write_package
from datagen.formats.shard import index_shard
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.exr import encode_view
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from model.checkpoint import CheckpointCard, load_checkpoint, save_checkpoint
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.captures.mesh_file import load_mesh, sound_mesh
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.photographs import PhotographSource, relative_exposure
from model.reconstruction.captures.read import read_capture
from model.training.dataset import load_view
from model.training.run_folder import RunProgress, load_state, save_state
from tests.datagen.small_library import box, with_uv
from tests.hostile import (
    PRISTINE,
    Case,
    CaseMaker,
    damage,
    mutate,
    set_traps,
    write_document,
    write_fresh,
)
from tests.model.training_data import floor_buffers, make_shard, view_record

torch.set_num_threads(1)
SIZE = (12, 8)
TOKENS = [
    "nan", "inf", "-inf", "1e999", "-1", "0", "2147483648", "99999999999999999999", "", "\0", "..", "'", "<",
    "&lt;", "/dev/zero", "../outside/secret.png", "link.png", "fifo.png", "/etc/passwd", "#", ",,,", "1e-320",
    "�", "[", "SIMPLE_PINHOLE", "FOV", "é" * 300,
]  # fmt: skip


def mutate_text(text: str, rng: random.Random) -> bytes:
    """The text with lines removed or repeated and words replaced or extended, or with damaged bytes."""
    action = rng.random()
    if action < PRISTINE:
        return text.encode()
    if action < 0.2:
        return damage(text.encode(), rng)
    lines = text.splitlines()
    for _ in range(rng.randint(1, 4)):
        if not lines:
            break
        at = rng.randrange(len(lines))
        action = rng.random()
        if action < 0.15:
            del lines[at]
        elif action < 0.3:
            lines[at:at] = lines[at : at + rng.randint(1, 3)]
        else:
            separators = [s for s in ' ,<>"=' if s in lines[at]] or [" "]
            separator = rng.choice(separators)
            words = lines[at].split(separator)
            word = rng.randrange(len(words))
            words[word] = rng.choice(TOKENS) if rng.random() < 0.8 else words[word] + rng.choice(TOKENS)
            lines[at] = separator.join(words)
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


def _picture() -> bytes:
    return encode_png(np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8))


def _mesh_bytes() -> bytes:
    return encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1])))


def _camera() -> Camera:
    return Camera(*SIZE, 10.0, 11.0, 6.0, 4.0, look_at([2.0, 0.5, 0.7], [0, 0, 0.3]))


def _read_all(path: Path, options: CaptureOptions | None = None) -> None:
    """Read a capture and the pixels of its first view; all photographs must be inside its folder."""
    capture = read_capture(path, options or CaptureOptions(max_width_px=32))
    folder = path if path.is_dir() else path.parent
    for view in capture.views:
        if isinstance(view.source, PhotographSource):
            assert view.source.path.resolve().is_relative_to(folder.resolve())
    image = capture.views[0].read()
    assert np.isfinite(image.color).all()


def capture_texts(name: str) -> dict[str, str]:
    """Text files, by name, of a valid capture in format ``name`` with the photograph ``images/a.png``."""
    return _TEXTS[name]()


def _capture(text: Callable[[], dict[str, str]], opened: str = "") -> CaseMaker:
    """Make a case of captures in a text format with one damaged file: a text, the photograph or the mesh."""

    def make(folder: Path) -> Case:
        root = folder / "capture"
        (root / "images").mkdir(parents=True)
        set_traps(root)
        set_traps(root / "images")
        for trap in root.glob("*.ply"):
            trap.unlink()  # several meshes would be ambiguous
        files = {**{name: content.encode() for name, content in text().items()},
                 "images/a.png": _picture(), "room.ply": _mesh_bytes()}  # fmt: skip
        for name, content in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(content)
        spoiled: set[str] = set()

        def write(rng: random.Random) -> Path:
            for name in spoiled:
                write_fresh(root / name, files[name])
            spoiled.clear()
            name = rng.choice([*text()] * 4 + ["images/a.png", "room.ply"])
            spoiled.add(name)
            is_text = name not in ("images/a.png", "room.ply")
            content = files[name]
            if name.endswith(".json"):
                write_document(root / name, json.loads(content), rng)
            else:
                data = mutate_text(content.decode(), rng) if is_text else damage(content, rng)
                write_fresh(root / name, data)
            return root / opened if opened else root

        return Case(write, _read_all)

    return make


def _pose_text() -> str:
    return " ".join(repr(float(v)) for v in _camera().world_from_camera.ravel())


def _transforms() -> dict[str, str]:
    frame = {"file_path": "images/a", "transform_matrix": np.eye(4).tolist(), "k1": 0.01}
    data = {"fl_x": 10.0, "w": SIZE[0], "h": SIZE[1], "cx": 6.0, "cy": 4.0, "frames": [frame, dict(frame)]}
    return {"transforms.json": json.dumps(data)}


def _capture_json() -> dict[str, str]:
    record = CaptureFile(
        name="room",
        photographs=(
            PhotographRecord(camera=ViewCamera.from_camera("a", _camera()), image="images/a.png"),
            PhotographRecord(camera=ViewCamera.from_camera("b", _camera()), image="images/a.png"),
        ),
        mesh=MeshRecord(file="room.ply"),
    )
    return {"capture.json": canonical_json(record).decode()}


def _colmap_text() -> dict[str, str]:
    return {
        "cameras.txt": "# head\n7 OPENCV 12 8 10 11 6 4 -0.1 0.03 0.001 -0.002\n8 PINHOLE 12 8 10 11 6 4\n",
        "images.txt": "# head\n1 1 0 0 0 0 0 2 7 a.png\n1.5 2.5 -1\n2 0.9 0.1 0 0 0 0 2 8 a.png\n\n",
    }


def colmap_binary(folder: Path) -> Case:
    """A damaged binary model of COLMAP."""
    root = folder / "capture"
    (root / "images").mkdir(parents=True)
    (root / "images" / "a.png").write_bytes(_picture())
    (root / "room.ply").write_bytes(_mesh_bytes())
    lens = struct.pack("<Q", 1) + struct.pack("<iiQQ8d", 7, 4, *SIZE, 10, 11, 6, 4, 0.1, 0, 0, 0)
    image = (
        struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 2, 7) + b"a.png\0" + struct.pack("<Q", 1) + bytes(24)
    )

    def write(rng: random.Random) -> Path:
        spoil_lens = rng.random() < 0.5
        write_fresh(root / "cameras.bin", damage(lens, rng) if spoil_lens else lens)
        write_fresh(root / "images.bin", image if spoil_lens else damage(image, rng))
        return root

    return Case(write, _read_all)


def _openmvg() -> dict[str, str]:
    lens = {
        "width": 12,
        "height": 8,
        "focal_length": 10.0,
        "principal_point": [6, 4],
        "disto_k3": [0.1, 0, 0],
    }
    view = {"local_path": "", "filename": "a.png", "id_intrinsic": 3, "id_pose": 10}
    data = {
        "sfm_data_version": "0.3", "root_path": "/home/else",
        "views": [{"key": 0, "value": {"ptr_wrapper": {"data": view}}}],
        "intrinsics": [{"key": 3, "value": {"ptr_wrapper": {"data": lens}}}],
        "extrinsics": [{"key": 10, "value": {"rotation": np.eye(3).tolist(), "center": [0, 0, -2]}}],
    }  # fmt: skip
    return {"sfm_data.json": json.dumps(data)}


def _metashape() -> dict[str, str]:
    return {"cameras.xml": f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="2"><sensor id="4" label="unknown" type="frame"><resolution width="12" height="8"/>
<calibration type="frame" class="adjusted"><resolution width="12" height="8"/><f>10</f>
<cx>0.5</cx><cy>-0.25</cy><k1>0.1</k1><b1>0.1</b1></calibration></sensor></sensors>
<cameras next_id="4"><camera id="0" sensor_id="4" label="a"><transform>{_pose_text()}</transform></camera>
<camera id="9" sensor_id="4" label="unaligned"/></cameras>
<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0.5 -0.25 2</translation>
<scale>1.75</scale></transform></chunk></document>
"""}  # fmt: skip


def _realitycapture_csv() -> dict[str, str]:
    head = "#cameras 1\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    return {"cameras.csv": f"{head}a.png,0,0,2,10,80,5,24,0.01,-0.02,0.1,0,0,0,0,0\n"}


def _realitycapture_xmp() -> dict[str, str]:
    return {"a.xmp": """<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"
xcr:FocalLength35mm="26" xcr:Skew="0" xcr:AspectRatio="1.01" xcr:PrincipalPointU="0.01"
xcr:PrincipalPointV="-0.015" xcr:DistortionModel="brown3">
<xcr:Position>0 0 2</xcr:Position>
<xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation>
<xcr:DistortionCoeficients>0.1 0 0 0 0 0</xcr:DistortionCoeficients>
</rdf:Description></rdf:RDF></x:xmpmeta>
"""}  # fmt: skip


def _bundler() -> dict[str, str]:
    return {
        "bundle.out": "# Bundle file v0.3\n1 0\n10.5 -0.1 0.02\n1 0 0\n0 1 0\n0 0 1\n0 0 -2\n",
        "list.txt": "./images/a.png 0 410\n",
    }


def _mitsuba() -> dict[str, str]:
    return {"scene.xml": """<scene version="3.0.0">
<default name="w" value="12"/>
<include filename="more.xml"/>
<sensor type="perspective" id="a"><float name="fov" value="60"/>
<transform name="to_world"><lookat origin="2, 0, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
<ref id="f"/></sensor>
</scene>
""", "more.xml": """<scene version="3.0.0">
<film type="hdrfilm" id="f"><integer name="width" value="$w"/><integer name="height" value="8"/></film>
</scene>
"""}  # fmt: skip


def _package() -> dict[str, str]:
    rows = tuple(tuple(float(v) for v in row) for row in _camera().world_from_camera)
    camera = AssetCamera(
        name="a", width_px=SIZE[0], height_px=SIZE[1], fx_px=10, fy_px=11, cx_px=6, cy_px=4,
        asset_from_camera=rows,  # type: ignore[arg-type]
    )  # fmt: skip
    asset = EnvironmentAsset(
        id="room", title="Room", provenance=Provenance(license="CC0-1.0"), cameras=(camera,),
        materials={"wall": SlotMaterial()}, parts=(Part(name="walls", mesh="room.ply", material="wall"),),
    )  # fmt: skip
    return {"asset.json": canonical_json(asset).decode()}


def _mesh_case(suffix: str) -> CaseMaker:
    def make(folder: Path) -> Case:
        set_traps(folder)
        content = _exported(suffix)

        def write(rng: random.Random) -> Path:
            data = content
            if suffix == ".obj":
                data = mutate_text(content.decode(), rng)
            elif suffix == ".gltf" and rng.random() < 0.8:
                data = json.dumps(mutate(json.loads(content), rng)).encode("utf-8", "surrogatepass")
            elif suffix == ".glb" and rng.random() < 0.6:
                length = struct.unpack_from("<I", content, 12)[0]
                document = json.dumps(mutate(json.loads(content[20 : 20 + length]), rng)).encode()
                rest = content[20 + length :]
                data = content[:12] + struct.pack("<I4s", len(document), b"JSON") + document + rest
            elif suffix == ".ply" and rng.random() < 0.4:
                header, body = content.split(b"end_header\n", 1)
                data = mutate_text(header.decode(), rng) + b"end_header\n" + body
            else:
                data = damage(content, rng)
            return write_fresh(folder / f"room{suffix}", data)

        def read(path: Path) -> None:
            mesh, _ = sound_mesh(load_mesh(path), np.eye(4), path)
            assert len(mesh.faces) and np.isfinite(mesh.positions).all()

        return Case(write, read)

    return make


def _exported(suffix: str) -> bytes:
    """Bytes of a box with UVs as a mesh file with this suffix."""
    import trimesh

    mesh = with_uv(box([-1, -1, 0], [1, 1, 1]))
    if suffix == ".ply":
        return encode_ply(mesh)
    visual = trimesh.visual.TextureVisuals(uv=mesh.uv)
    shape = trimesh.Trimesh(mesh.positions, mesh.faces, visual=visual, process=False)
    exported = shape.export(file_type=suffix[1:])
    if suffix == ".gltf":
        import base64

        document = json.loads(exported["model.gltf"])
        for buffer in document["buffers"]:
            data = base64.b64encode(exported[buffer["uri"]]).decode()
            buffer["uri"] = f"data:application/octet-stream;base64,{data}"
        return json.dumps(document).encode()
    return exported if isinstance(exported, bytes) else exported.encode()


def photograph(folder: Path) -> Case:
    """Damaged photographs in several formats, some with the suffix of another format."""
    import cv2

    pixels = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0x829A: 0.01, 0x829D: 2.8, 0x8827: 200})
    originals: list[tuple[str, bytes]] = []
    for suffix, form in ((".jpg", "JPEG"), (".png", "PNG"), (".tif", "TIFF")):
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, form, exif=exif)
        originals.append((suffix, stream.getvalue()))
    wide = pixels.astype(np.uint16) * 257
    originals.append((".tif", cv2.imencode(".tif", wide)[1].tobytes()))
    originals.append((".exr", encode_view({"beauty": pixels.astype(np.float32) / 255}, num_threads=1)))

    def write(rng: random.Random) -> Path:
        suffix, content = rng.choice(originals)
        if rng.random() < 0.1:
            suffix = rng.choice((".jpg", ".png", ".tif", ".exr"))
        return write_fresh(folder / f"image{suffix}", damage(content, rng))

    def read(path: Path) -> None:
        source = PhotographSource(path, _camera(), None, "auto")
        relative_exposure(path)
        assert np.isfinite(source.read(_camera()).color).all()

    return Case(write, read)


def rendered(folder: Path) -> Case:
    """A damaged shard, read as a capture with the library that it was rendered from."""
    package = write_package(folder / "library" / "room", _room(), {"room.ply": _mesh_bytes()})
    shard = _small_shard(folder, package.sha256)

    def read(path: Path) -> None:
        _read_all(path, CaptureOptions(library=(folder / "library",)))

    return Case(lambda rng: write_fresh(folder / "shard.tar", _damaged_shard(shard, rng)), read)


def training_shard(folder: Path) -> Case:
    """A damaged shard, read as in training: by offsets, view by view."""
    data = make_shard(folder, "room-00000", 1, width=SIZE[0], height=SIZE[1]).read_bytes()
    names = ("beauty", "roughness", "normal_world", "depth_z_m", "surface_mask")

    def read(path: Path) -> None:
        for place in index_shard(path):
            load_view(place, names)

    return Case(lambda rng: write_fresh(folder / "shard.tar", _damaged_shard(data, rng)), read)


def _room() -> EnvironmentAsset:
    return EnvironmentAsset.model_validate(json.loads(_package()["asset.json"]))


def _small_shard(folder: Path, package_sha256: str) -> bytes:
    from datagen.formats.shard import write_shard

    configuration = Configuration(
        id="small-00000",
        index=0,
        seed=1,
        environment=PlacedAsset(name="environment", asset="room"),
        cameras=(ViewCamera.from_camera("view-000", _camera()),),
        assets={"room": package_sha256},
    )
    exr = encode_view({"beauty": floor_buffers(_camera(), 0)["beauty"]}, num_threads=1)
    record = {**view_record(configuration, 0, exr), "buffers": ["beauty"], "exr_sha256": sha256_hex(exr)}
    members = []
    for suffix, content in (("exr", exr), ("json", json.dumps(record).encode())):
        path = folder / f"view-000.{suffix}"
        path.write_bytes(content)
        members.append((f"small-00000/view-000.{suffix}", path))
    stream = io.BytesIO()
    write_shard(stream, canonical_json(configuration), members)
    return stream.getvalue()


def _damaged_shard(shard: bytes, rng: random.Random) -> bytes:
    """The shard damaged anywhere, within one tar block, or in digits of its documents."""
    if rng.random() < 0.3:
        return damage(shard, rng)
    if rng.random() < 0.4:
        data = bytearray(shard)
        at = 512 * rng.randrange(len(data) // 512)
        data[at : at + 512] = damage(bytes(data[at : at + 512]), rng)[:512].ljust(512, b"\0")
        return bytes(data)
    # replacements of equal length keep the tar readable
    data = bytearray(shard)
    digits = [k for k, c in enumerate(data) if c in b"0123456789" and data[k - 1 : k] in (b" ", b"[", b".")]
    for _ in range(rng.randint(1, 3)):
        data[rng.choice(digits)] = rng.choice(b'-9e"[{}]')
    return bytes(data)


def checkpoint(folder: Path) -> Case:
    """A checkpoint: damaged, with a mutated header, or with a mutated card."""
    torch.manual_seed(0)
    config = NetworkConfig(base_channels=1, global_channels=1)
    card = CheckpointCard(network=config, loss="l1", phase="joint", step=1, metrics={"a": 0.5})
    path = folder / "tiny.safetensors"
    save_checkpoint(path, card, MaterialNetwork(config))
    original = path.read_bytes()
    return Case(lambda rng: write_fresh(path, _damaged_safetensors(original, "card", rng)), load_checkpoint)


def run_state(folder: Path) -> Case:
    """A damaged state file of an unfinished training run."""
    save_state(folder, RunProgress(phase=1, step=2), torch.nn.Linear(2, 2), None)
    path = folder / "state.safetensors"
    original = path.read_bytes()

    def write(rng: random.Random) -> Path:
        write_fresh(path, _damaged_safetensors(original, "progress", rng))
        return folder

    return Case(write, load_state)


def _damaged_safetensors(original: bytes, key: str, rng: random.Random) -> bytes:
    length = struct.unpack_from("<Q", original)[0]
    header, body = json.loads(original[8 : 8 + length]), original[8 + length :]
    action = rng.random()
    if action < 0.3:
        return damage(original, rng)
    if action < 0.6:
        card = json.loads(header["__metadata__"][key])
        header["__metadata__"][key] = json.dumps(mutate(card, rng))
    elif action < 0.9:
        header = mutate(header, rng)
    else:
        name = rng.choice([n for n in header if n != "__metadata__"])
        header[name] = {"dtype": rng.choice(("F32", "F64", "I64", "BOOL", "F8_E4M3")),
                        "shape": [rng.choice((0, 1, 2**31, 2**62))] * rng.randint(0, 4),
                        "data_offsets": [0, rng.choice((0, 4, 2**40))]}  # fmt: skip
        body = (
            body
            if rng.random() < 0.5
            else struct.pack("<f", rng.choice((float("nan"), 0.0))) * (len(body) // 4)
        )
    text = json.dumps(header).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(text)) + text + body


_TEXTS: dict[str, Callable[[], dict[str, str]]] = {
    "capture_json": _capture_json,
    "transforms": _transforms,
    "colmap_text": _colmap_text,
    "openmvg": _openmvg,
    "metashape": _metashape,
    "realitycapture_csv": _realitycapture_csv,
    "realitycapture_xmp": _realitycapture_xmp,
    "bundler": _bundler,
    "mitsuba_sensors": _mitsuba,
    "package_with_photographs": _package,
}
CASES: dict[str, CaseMaker] = {
    **{
        name: _capture(text, "scene.xml" if name == "mitsuba_sensors" else "")
        for name, text in _TEXTS.items()
    },
    "colmap_binary": colmap_binary,
    **{f"mesh{suffix.replace('.', '_')}": _mesh_case(suffix) for suffix in (".ply", ".obj", ".gltf", ".glb")},
    "photograph": photograph,
    "rendered_shard": rendered,
    "training_shard": training_shard,
    "checkpoint": checkpoint,
    "run_state": run_state,
}
