"""Training on shards, of this machine and of a server; each process has its own."""

import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import islice

import pytest
import torch
from helpers import micro
from helpers.micro import lines, run, same_weights
from helpers.nodes.processes import free_port, train_all, words
from helpers.refusals import refused, refused_command

pytest.importorskip("webdataset")

from gamba_warp.train.batches import open_data  # noqa: E402
from gamba_warp.train.checkpoint import list_checkpoints  # noqa: E402
from gamba_warp.train.data.shards import Shards, Unreachable  # noqa: E402
from gamba_warp.train.sources.pack import write_pack  # noqa: E402

OBJECTS = 9  # one of them is held out


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", OBJECTS)


@pytest.fixture(scope="module")
def packed(data):
    """Shards of two objects each."""
    out = data.with_name("shards")
    counts, _ = write_pack(data, out, shard_mb=0.008)
    assert [*counts.values()] == [2, 2, 2, 2, 1]
    return out


@contextmanager
def served(folder):
    """Serve a folder; yield the address and the requests."""
    asked = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, format, *arguments):
            asked.append(str(arguments[0]))

    handler = partial(Handler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", asked
        finally:
            server.shutdown()


def order(folder, count, seed=0):
    samples = islice(Shards(str(folder), "train").stream(seed), count)
    return [sample["__key__"] for sample in samples]


def test_an_epoch_has_each_object_once_in_an_order_of_its_own(packed):
    found = order(packed, 16)
    first, second = found[:8], found[8:]
    assert sorted(first) == sorted(second) == [f"cloud{letter}" for letter in "abcdefgh"]
    assert first != second != sorted(second)
    assert order(packed, 16) == found != order(packed, 16, seed=1)


@pytest.mark.parametrize("processes", [2, 3])
def test_processes_share_the_shards(packed, monkeypatch, processes):
    monkeypatch.setenv("WORLD_SIZE", str(processes))
    found = []
    for rank in range(processes):
        monkeypatch.setenv("RANK", str(rank))
        found.append({*order(packed, 99)})
    assert sum(map(len, found)) == 8 and len(set.union(*found)) == 8


def test_a_process_without_a_shard_is_one_line(packed, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "5")
    monkeypatch.setenv("RANK", "4")
    (error,) = islice(Shards(str(packed), "train").stream(0), 1)
    assert isinstance(error, Unreachable)
    assert "fewer shards than workers" in str(error) and "\n" not in str(error)


@pytest.mark.slow
def test_two_processes_train_on_one_set_of_shards(packed, tmp_path):
    ends = train_all([words(packed, tmp_path / "run", "--steps", 4)] * 2)
    assert [end.returncode for end in ends] == [0, 0], ends
    assert len(lines(tmp_path / "run", "train")) == 4


@pytest.mark.parametrize("workers", [1, 3])
def test_shards_of_a_server_train_like_local_ones(packed, tmp_path, workers):
    length, views = {"steps": 9}, {"workers": 1}
    assert run(packed, tmp_path / "local", length=length, views=views) == 0
    assert run(packed, tmp_path / "again", length=length, views=views) == 0
    paths = [tmp_path / name / "model.safetensors" for name in ("local", "again", "far")]
    assert same_weights(*paths[:2])
    with served(packed) as (address, asked):
        views = {"workers": workers}
        assert run(f"{address}", tmp_path / "far", length=length, views=views) == 0
        assert sum("/train-" in line for line in asked) >= 4
    if workers == 1:
        assert same_weights(paths[0], paths[2])


def test_the_held_out_objects_of_shards_are_those_of_the_files(data, packed, tmp_path):
    parts = [open_data(micro.options(source, tmp_path)).held_out for source in (data, packed)]
    one, other = (part.dataset.load(part.dataset.uids[0]) for part in parts)
    assert one.uid == other.uid == "cloudi" and torch.equal(one.images, other.images)
    assert run(packed, tmp_path / "run", run={"val_every": 1}, length={"steps": 1}) == 0
    assert lines(tmp_path / "run", "val")


def test_a_resumed_run_goes_on_with_a_new_pass(packed, tmp_path):
    out = tmp_path / "run"
    assert run(packed, out, length={"steps": 9}, run={"save_every": 4}) == 0
    resumed = {"resume": str(list_checkpoints(out)[0])}
    assert run(packed, tmp_path / "rest", length={"steps": 9}, run=resumed) == 0
    first, rest = lines(out, "train"), lines(tmp_path / "rest", "train")
    assert [line["step"] for line in rest] == [*range(5, 10)]
    assert [line["lr"] for line in rest] == [line["lr"] for line in first[4:]]
    write_pack(packed.with_name("clouds"), tmp_path / "other")
    refused("objects", run, tmp_path / "other", tmp_path / "no", run=resumed)


def test_a_damaged_object_is_skipped_and_a_damaged_tar_ends_the_run(data, tmp_path, capsys):
    out = tmp_path / "shards"
    write_pack(data, out)
    path = out / "train-00000.tar"
    content = path.read_bytes()
    path.write_bytes(content.replace(b"transform_matrix", b"transform_matrIx", 1))
    assert run(out, tmp_path / "run") == 1
    said = capsys.readouterr().out
    assert said.count("is skipped") == 1 and "no transform_matrix" in said
    path.write_bytes(content[: len(content) // 2 + 700])  # within an image
    message = refused("the shards cannot be read: ", run, out, tmp_path / "short")
    assert len(message) < 200
    assert list_checkpoints(tmp_path / "short"), "nothing is lost"


def test_options_of_folders_are_refused(data, packed, tmp_path):
    for name, value in (("extra", (data,)), ("cache", True)):
        line = f"--{name}: needs a folder of objects"
        refused(line, run, packed, tmp_path / "run", views={name: value})


def test_a_dead_server_is_one_line(tmp_path, capsys):
    address = f"http://127.0.0.1:{free_port()}"
    refused_command(capsys, "train", [address, "--out", tmp_path / "run"], address, "shards-train")
    assert not (tmp_path / "run").exists()


def test_scanned_objects_are_left_out(data, tmp_path, monkeypatch, capsys):
    from gamba_warp.train.data import shards

    write_pack(data, tmp_path / "shards")
    monkeypatch.setattr(shards, "scanned", lambda uids: {"clouda"} & uids)
    assert run(tmp_path / "shards", tmp_path / "run") == 1
    said = capsys.readouterr().out
    assert "clouda is skipped: " in said and "one of Google Scanned Objects" in said
