# SPDX-License-Identifier: MIT
"""WebDataset and Hugging Face's `datasets` read shards, and `ShardReader` reads older ones."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.formats.base import canonical_json, parse_model
from datagen.formats.shard import CONFIGURATION_MEMBERS, ShardReader, index_shard, write_shard
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view
from datagen.inspection.shard_check import ShardJob, verify_shard
from tests.datagen.small_dataset import make_configuration, make_view_files

NUM_VIEWS = 7  # `datasets` infers types from the first five records


def _changed(record: dict[str, Any], shard: int, view: int) -> dict[str, Any]:
    """Return a record whose instances depend on view and shard; that of the last view has optional fields."""
    names = [{"id": k + 1, "name": f"object-{shard}-{k}"} for k in range(1 + view % 3)]
    record = {**record, "instances": names, "name": f"view-{view:03d}"}
    if view == NUM_VIEWS - 1:
        record["render"] = {**record["render"], "estimated_rel_mse": 0.01, "most_path_samples": 64}
    return record


def make_shards(folder: Path, num_shards: int = 2) -> list[Path]:
    """Write shards whose views have different instances; return their paths."""
    paths = []
    for shard in range(num_shards):
        work = folder / f"work-{shard}"
        work.mkdir(parents=True)
        configuration = make_configuration(NUM_VIEWS)
        members = make_view_files(work, configuration)
        for view, (_, path) in enumerate(m for m in members if m[0].endswith(".json")):
            path.write_bytes(canonical_json(_changed(json.loads(path.read_bytes()), shard, view)))
        paths.append(folder / f"shard-{shard}.tar")
        with paths[-1].open("wb") as file:
            write_shard(file, canonical_json(configuration), members)
    return paths


def as_older(path: Path, out: Path) -> Path:
    """Convert a shard to result revision 7: an older member name, ids as keys, and nulls. Return ``out``."""
    with tarfile.open(path) as source, tarfile.open(out, "w", format=tarfile.USTAR_FORMAT) as target:
        for info in source:
            file = source.extractfile(info)
            assert file is not None
            data = file.read()
            if info.name in CONFIGURATION_MEMBERS:
                info.name = "__meta__/configuration.json"
            elif info.name.endswith(".json"):
                record = json.loads(data)
                record["version"] = 1
                for field in ("instances", "materials"):
                    record[field] = {str(entry["id"]): entry["name"] for entry in record[field]}
                record["render"].setdefault("max_energy_left", None)
                data = canonical_json(record)
            info.size = len(data)
            target.addfile(info, io.BytesIO(data))
    return out


_LOAD = """
import sys, datasets
files = {"train": sys.argv[2:]}
whole = datasets.load_dataset("webdataset", data_files=files, cache_dir=sys.argv[1], split="train")
stream = datasets.load_dataset("webdataset", data_files=files, streaming=True, split="train")
for loaded in (list(whole), list(stream)):
    for row in loaded:
        names = ",".join(entry["name"] for entry in row["json"]["instances"])
        print(row["__key__"], len(row["exr"]), row["json"]["name"], names)
"""


def _hugging_face(paths: list[Path], cache: Path) -> subprocess.CompletedProcess[str]:
    """Print records read by `datasets` in a separate process, since the library keeps threads and a cache."""
    command = [sys.executable, "-c", _LOAD, str(cache), *map(str, paths)]
    environment = {"HF_HOME": str(cache), "HF_HUB_OFFLINE": "1", "HF_DATASETS_DISABLE_PROGRESS_BARS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_hugging_face_reads_shards(tmp_path: Path) -> None:
    paths = make_shards(tmp_path)
    done = _hugging_face(paths, tmp_path / "cache")
    assert done.returncode == 0, done.stderr[-3000:]
    expected = []
    for path in paths:
        for place in index_shard(path):
            data = path.read_bytes()[place.record[0] : place.record[0] + place.record[1]]
            record = parse_model(ViewRecord, json.loads(data), path)
            names = ",".join(record.instances.values())
            expected.append(f"{place.name} {place.exr[1]} {record.name} {names}")
    assert done.stdout.split("\n")[:-1] == expected * 2


def test_hugging_face_could_not_read_older_shards(tmp_path: Path) -> None:
    """`datasets` refuses shards of result revision 7."""
    older = [as_older(path, tmp_path / f"older-{k}.tar") for k, path in enumerate(make_shards(tmp_path))]
    done = _hugging_face(older, tmp_path / "cache")
    assert done.returncode != 0 and "don't share the same prefix" in done.stderr


def test_webdataset_reads_pixels_and_records(tmp_path: Path) -> None:
    import webdataset

    paths = make_shards(tmp_path)
    samples = list(webdataset.WebDataset([str(p) for p in paths], shardshuffle=False))
    assert [s["__key__"] for s in samples] == [p.name for path in paths for p in index_shard(path)]
    for sample, view in zip(samples, [v for path in paths for v in ShardReader(path)], strict=True):
        assert json.loads(sample["json"])["instances"] == [
            {"id": int(key), "name": name} for key, name in view.record.instances.items()
        ]
        decoded = decode_view(sample["exr"], ["beauty"])
        np.testing.assert_array_equal(decoded["beauty"], view.buffers["beauty"])


def test_older_shards_are_read_identically(tmp_path: Path) -> None:
    (path,) = make_shards(tmp_path, 1)
    older = as_older(path, tmp_path / "older.tar")
    assert ShardReader(older).configuration() == ShardReader(path).configuration()
    assert list(ShardReader(older).records()) == list(ShardReader(path).records())
    assert [p.name for p in index_shard(older)] == [p.name for p in index_shard(path)]
    for one, other in zip(ShardReader(older), ShardReader(path), strict=True):
        assert one.record == other.record and one.buffers.keys() == other.buffers.keys()
    found = [fault for fault in verify_shard(ShardJob(older, "older")).faults if fault.check == "member"]
    assert found == []


@pytest.mark.parametrize(
    ("instances", "expected"),
    [
        ([{"id": 1, "name": "a"}, {"id": 1, "name": "b"}], "every id once, not 1 twice"),
        ([{"id": "1", "name": "a"}], 'entries of the form {"id": 1'),
        ([{"id": 0, "name": "a"}], "match pattern"),
        ([{"id": 1, "name": 5}], "valid string"),
        ({"floor": "a"}, "match pattern"),
        (["a"], "entries of the form"),
    ],
)
def test_invalid_instance_names_are_refused(tmp_path: Path, instances: object, expected: str) -> None:
    (path,) = make_shards(tmp_path, 1)
    record = next(ShardReader(path).records()).model_dump(mode="json")
    with pytest.raises(InputError) as caught:
        parse_model(ViewRecord, {**record, "instances": instances}, "view.json")
    assert expected in str(caught.value)
