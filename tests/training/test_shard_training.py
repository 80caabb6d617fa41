"""Training by shards: each process has its own, resumed runs go on with the same objects."""

import shutil
import signal
import subprocess
import threading
import time
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from helpers import micro
from helpers.forked import python
from helpers.micro import lines, run, same_weights
from helpers.nodes.processes import environment, free_port, run_all, words
from helpers.refusals import refused

pytest.importorskip("webdataset")

from gamba_warp import cli  # noqa: E402
from gamba_warp.data import shard_cache, shards  # noqa: E402
from gamba_warp.data.dataset import open_dataset  # noqa: E402
from gamba_warp.train.checkpoint import list_checkpoints  # noqa: E402
from gamba_warp.train.data.order import ShardOrder  # noqa: E402
from gamba_warp.train.sources.pack import PackSettings, take_index, write_pack  # noqa: E402

OBJECTS = 9  # one of them is held out
BY_SHARD = {"sampler": "shards", "shuffle_buffer": 3}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", OBJECTS)


@pytest.fixture(scope="module")
def packed(data):
    """Shards of two objects each."""
    out = data.with_name("shards")
    write_pack(data, out, PackSettings(shard_bytes=8_000), 1)
    sizes = [len(shard.objects) for shard in shards.read_index(out).shards]
    assert sizes == [2, 2, 2, 2, 1]
    return out


@contextmanager
def served(folder, broken=(), silent=()):
    """Serve a folder; yield the address and the requests.

    Those in ``broken`` fail; those in ``silent`` get half of the file, and then nothing.
    """
    asked, over = [], threading.Event()

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            if len(asked) in broken:
                self.send_error(404)  # curl itself retries 500
            elif len(asked) in silent:
                content = (folder / self.path[1:]).read_bytes()
                self.send_response(200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content[: len(content) // 2])
                self.wfile.flush()
                over.wait(30)
            else:
                super().do_GET()

        def log_message(self, *arguments):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        over.set()
        server.shutdown()
        server.server_close()
        thread.join()


def fetch(address, out):
    return cli.run("data fetch", [str(out), "--address", address])


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(shard_cache, "_DELAY", 0.01)
    monkeypatch.setattr(shard_cache, "_failed", {})


def orders(names, buffer, processes, epoch, monkeypatch):
    made = []
    for rank in range(processes):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", str(processes))
        made.append(ShardOrder(names, buffer, 0, processes)(epoch).tolist())
    monkeypatch.delenv("RANK")
    monkeypatch.delenv("WORLD_SIZE")
    return made


@pytest.mark.parametrize("processes", [1, 2, 3])
def test_processes_share_the_shards_of_an_epoch(monkeypatch, processes):
    names = [f"{position // 5}" for position in range(60)]  # twelve shards of five
    found = [orders(names, 8, processes, epoch, monkeypatch) for epoch in range(2)]
    for made in found:
        assert sorted(sum(made, [])) == [*range(60)]
        own = [{names[position] for position in order} for order in made]
        assert sum(map(len, own)) == 12, "no shard is read by two processes"
    assert found[0] != found[1] and found[0] == orders(names, 8, processes, 0, monkeypatch)


def test_a_buffer_mixes_shards_but_reads_few_at_a_time(monkeypatch):
    names = [f"{position // 10:02d}" for position in range(200)]
    (order,) = orders(names, 30, 1, 0, monkeypatch)
    seen = [names[position] for position in order]
    assert len(set(seen[:10])) > 1, "mixed"
    last, first = {}, {}
    for at, name in enumerate(seen):
        last[name] = at
        first.setdefault(name, at)
    spans = [last[name] - first[name] for name in first]
    assert np.median(spans) < 100, "a shard is done long before the end"


def test_a_process_without_a_shard_is_one_line():
    refused("3 processes need at least as many shards, there are 2", ShardOrder, "aabb", 9, 0, 3)


def test_uneven_shards_give_each_process_as_many_objects(monkeypatch):
    made = orders("aaaaab", 9, 2, 0, monkeypatch)
    assert [len(order) for order in made] == [3, 3]


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bits(packed, tmp_path):
    """SIGKILL in the middle of an epoch; the next start continues from the checkpoint."""
    options = ["--steps", 9, "--save-every", 1, "--sampler", "shards", "--shuffle-buffer", 3]

    def command(out):
        return [python(), "-m", "gamba_warp.train", *words(packed, out, *options)]

    quiet, killed = tmp_path / "quiet", tmp_path / "killed"
    subprocess.run(command(quiet), env=environment(), check=True)
    process = subprocess.Popen(command(killed), env=environment())
    limit = time.monotonic() + 120
    while not (killed / "checkpoints" / "step_000002").is_dir() and time.monotonic() < limit:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    subprocess.run(command(killed), env=environment(), check=True)
    first, second = lines(killed, "start")
    assert second["resumed_from"] and not first["resumed_from"] and second["step"] >= 2
    assert same_weights(quiet / "model.safetensors", killed / "model.safetensors")
    losses = {line["step"]: line["loss"] for line in lines(killed, "train")}
    assert losses == {line["step"]: line["loss"] for line in lines(quiet, "train")}


def test_a_resumed_run_takes_the_same_objects(packed, tmp_path):
    views = {"views": BY_SHARD}
    assert run(packed, tmp_path / "whole", length={"steps": 9}, run={"save_every": 4}, **views) == 0
    half = str(list_checkpoints(tmp_path / "whole")[0])
    resumed = {"resume": half}
    assert run(packed, tmp_path / "rest", length={"steps": 9}, run=resumed, **views) == 0
    paths = [tmp_path / name / "model.safetensors" for name in ("whole", "rest")]
    assert same_weights(*paths)
    write_pack(packed, tmp_path / "other", PackSettings(shard_bytes=1), 1)
    refused("objects", run, tmp_path / "other", tmp_path / "no", run=resumed, **views)


def test_the_order_by_shards_needs_shards(data, tmp_path):
    refused("clouda is in no shard", run, data, tmp_path / "run", views=BY_SHARD)


def test_shards_of_a_server_train_like_local_ones(packed, tmp_path, capsys):
    assert run(packed, tmp_path / "local", views=BY_SHARD) == 0
    with served(packed, broken=(1, 3)) as (address, asked):
        assert fetch(f"{address}/", tmp_path / "remote") == 0
        assert "9 objects in 5 shards" in capsys.readouterr().out
        assert len(asked) == 2, "the first try failed; no tar is fetched yet"
        assert run(tmp_path / "remote", tmp_path / "far", views=BY_SHARD) == 0
        assert sum("train-" in path for path in asked) == 5, "each once, and one try failed"
        dataset = open_dataset(tmp_path / "remote")
        assert (dataset.load("clouda").images == open_dataset(packed).load("clouda").images).all()
    paths = [tmp_path / name / "model.safetensors" for name in ("local", "far")]
    assert same_weights(*paths)


def test_an_address_is_trained_on_directly(packed, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "cache"))
    with served(packed) as (address, _):
        own = [f"{address}/", *words("DATA", tmp_path / "far", "--steps", 4)[1:]]
        assert cli.run("train", [*own, "--sampler", "shards", "--shuffle-buffer", "3"]) == 0
        assert f"shards of {address} are kept in {tmp_path / 'cache'}" in capsys.readouterr().out
        assert cli.run("train", [own[0], "--extra", address]) == 2
        assert "gamba data fetch --address" in capsys.readouterr().err
    local = [str(packed), *words("DATA", tmp_path / "near", "--steps", 4)[1:]]
    assert cli.run("train", [*local, "--sampler", "shards", "--shuffle-buffer", "3"]) == 0
    assert same_weights(*(tmp_path / name / "model.safetensors" for name in ("far", "near")))


@pytest.mark.parametrize("address", ["file:///etc", "pipe://touch", "http://h/a b"])
def test_other_addresses_are_not_trained_on(address, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "cache"))
    assert cli.run("train", [address]) == 2
    said = capsys.readouterr().err
    assert "expected http(s)://, s3:// or gs://" in said and said.count("\n") == 1


def test_the_cache_keeps_its_limit(packed, tmp_path):
    largest = max(shard.bytes for shard in shards.read_index(packed).shards)
    with served(packed) as (address, asked):
        take_index(address, tmp_path / "remote", int(2.5 * largest))
        refused("its cache .* --sampler shards", run, tmp_path / "remote", tmp_path / "no")
        dataset, sizes = open_dataset(tmp_path / "remote"), []
        for uid in [*dataset.uids, *dataset.uids]:
            dataset.load(uid)
            found = [*(tmp_path / "remote" / "cache").glob("*.tar")]
            sizes.append(sum(path.stat().st_size for path in found))
        assert largest < max(sizes) <= 2.5 * largest
        assert len(asked) > 6, "what was removed is fetched again"


def test_a_dead_server_ends_a_run_with_one_line_and_a_checkpoint(packed, tmp_path, monkeypatch):
    with served(packed) as (address, _):
        assert fetch(address, tmp_path / "remote") == 0
        open_dataset(tmp_path / "remote").load("clouda")
    out, tries = tmp_path / "run", []
    real = shard_cache._download
    monkeypatch.setattr(shard_cache, "_download", lambda *a: tries.append(a[0]) or real(*a))
    message = refused(
        "cannot be fetched, 4 tries: curl", run, tmp_path / "remote", out, views=BY_SHARD
    )
    assert message.startswith("http://127.0.0.1:") and len(message) < 200
    assert list_checkpoints(out), "nothing is lost"
    assert max(tries.count(url) for url in tries) == 4, "not again for each of its objects"
    assert run(packed, out, views=BY_SHARD) == 0  # it goes on with the same shards
    assert run(packed, tmp_path / "whole", views=BY_SHARD) == 0
    assert same_weights(out / "model.safetensors", tmp_path / "whole" / "model.safetensors")


def test_a_server_that_falls_silent_is_asked_again(packed, tmp_path, monkeypatch):
    monkeypatch.setattr(shard_cache, "_SILENT", 0.5)
    with served(packed, silent=(1, 3)) as (address, asked):
        assert fetch(address, tmp_path / "remote") == 0
        dataset = open_dataset(tmp_path / "remote")
        assert (dataset.load("clouda").images == open_dataset(packed).load("clouda").images).all()
        assert len(asked) == 4, "the index and a shard, twice each"


def test_a_server_that_stays_silent_is_one_line(packed, tmp_path, monkeypatch):
    monkeypatch.setattr(shard_cache, "_SILENT", 0.2)
    with served(packed, silent=range(2, 9)) as (address, asked):
        assert fetch(address, tmp_path / "remote") == 0
        dataset = open_dataset(tmp_path / "remote")
        message = refused("cannot be fetched, 4 tries: no byte for 0.2 s", dataset.load, "clouda")
        assert message.startswith(address) and len(message) < 200 and len(asked) == 5
    assert not [*(tmp_path / "remote" / "cache").iterdir()], "nothing half-written"


def test_a_dead_address_is_one_line(tmp_path, capsys):
    address = f"http://127.0.0.1:{free_port()}"
    assert fetch(address, tmp_path / "remote") == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and f"{address}/shards.json: cannot be fetched, 4 tries" in said[0]
    assert not (tmp_path / "remote").exists()


def test_a_folder_of_other_files_is_left_alone(packed, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    shutil.copytree(packed, tmp_path / "own")
    with served(packed) as (address, asked):
        assert fetch(address, tmp_path) == 2
        assert fetch(address, tmp_path / "own") == 2
        assert not asked
    said = capsys.readouterr().err
    assert "holds other files (notes.txt)" in said and "holds shards of its own" in said


@pytest.mark.parametrize("address", ["pipe:touch x", "file:///etc", "http://a b", "http://h/{1,2}"])
def test_other_addresses_are_refused(tmp_path, address, capsys):
    assert fetch(address, tmp_path / "remote") == 2
    assert "expected http(s)://" in capsys.readouterr().err


@pytest.mark.parametrize("fault", ["larger", "shorter", "another"])
def test_a_server_with_other_shards_is_one_line(packed, tmp_path, fault):
    shutil.copytree(packed, tmp_path / "there")
    with served(tmp_path / "there") as (address, _):
        assert fetch(address, tmp_path / "remote") == 0
        for path in (tmp_path / "there").glob("*.tar"):
            content = path.read_bytes()
            changed = {
                "larger": content + bytes(10 << 20),
                "shorter": content[:-100],
                "another": content[:-100] + b"x" * 100,
            }
            path.write_bytes(changed[fault])
        reason = "larger than stated" if fault == "larger" else "not the file of the index"
        refused(reason, open_dataset(tmp_path / "remote").load, "clouda")
    cache = tmp_path / "remote" / "cache"
    assert not [*cache.iterdir()], "nothing half-written"


@pytest.mark.slow
def test_two_nodes_read_their_own_shards(packed, tmp_path):
    """Two torchruns, each with a cache of its own, as on two machines: one epoch of two steps."""
    port = free_port()
    with served(packed) as (address, _):
        commands = []
        for node in ("a", "b"):
            assert fetch(address, tmp_path / node) == 0
            own = ["--steps", 2, "--sampler", "shards"]
            commands.append(
                [python(), "-m", "torch.distributed.run", "--nnodes", "2"]
                + ["--nproc-per-node", "1", "--rdzv-id", "gamba", "--rdzv-backend", "c10d"]
                + ["--rdzv-endpoint", f"127.0.0.1:{port}", "--local-addr", "127.0.0.1"]
                + ["-m", "gamba_warp.train", *words(tmp_path / node, tmp_path / "run", *own)]
            )
        ends = run_all(commands, PYTHON_EXEC=python())
    assert [end.code for end in ends] == [0, 0], ends
    first, second = ({p.name for p in (tmp_path / n / "cache").glob("*.tar")} for n in "ab")
    assert len(first) == len(second) == 2 and not first & second


def test_a_bucket_of_s3_is_read_by_aws(packed, tmp_path, monkeypatch):
    program = tmp_path / "aws"
    program.write_text(
        f'#!/bin/sh\n[ "$1 $2 $3" = "s3 cp --only-show-errors" ] && [ "$5" = "-" ] || exit 9\n'
        f'exec cat "{packed}/${{4#s3://bucket/}}"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert fetch("s3://bucket", tmp_path / "remote") == 0
    dataset = open_dataset(tmp_path / "remote")
    assert (dataset.load("clouda").images == open_dataset(packed).load("clouda").images).all()
    monkeypatch.setenv("PATH", "/nowhere")
    refused("needs the program aws", dataset.load, dataset.uids[-1])
