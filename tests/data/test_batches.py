"""Batches prepared ahead: the same for any number of threads, errors in their step, a quick end."""

import threading
import time
from functools import partial

import pytest
import torch
from helpers import micro
from helpers.micro import ALONE, lines, run
from safetensors.torch import load_file

from gamba_warp.data.dataset import open_dataset
from gamba_warp.data.prefetch import Prefetcher
from gamba_warp.errors import UserError
from gamba_warp.train import batches
from gamba_warp.train.batches import BatchQueue, BatchSource
from gamba_warp.train.ddp import World


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", objects=6)


def source_of(root, batch_size=3, **views):
    options = micro.options(root, root, views={"background": "random", **views})
    dataset = open_dataset(root, "train")
    return BatchSource(
        dataset,
        options.model_config(),
        objects=list(range(len(dataset))),
        batch_size=batch_size,
        reference=None,
        views=options.views,
        seed=5,
    )


def same(a, b):
    assert a.uids == b.uids
    for name in ("inputs", "targets", "background"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for name in ("cameras", "input_cameras"):
        assert torch.equal(getattr(a, name).viewmats, getattr(b, name).viewmats), name


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_the_queue_gives_the_batches_of_the_source(data, workers):
    def novel(number):
        return number % 3  # another number at every batch, so that a mix-up would show

    alone = source_of(data)
    queue = BatchQueue(source_of(data), workers, novel, ALONE, last=7)
    for number in range(7):
        same(queue.take(number), alone.batch(number, novel(number)))
    queue.close()


def test_a_run_has_the_same_weights_for_any_number_of_threads(data, tmp_path):
    views = {"background": "random", "views_last": 5, "accumulate": 2, "mirror": 0.5}
    for workers in (1, 3):
        changed = {"views": {**views, "workers": workers}, "length": {"steps": 4}}
        assert run(data, tmp_path / str(workers), **changed) == 0
    one, three = (load_file(tmp_path / name / "model.safetensors") for name in "13")
    assert all(torch.equal(one[name], three[name]) for name in one)
    losses = [[r["loss"] for r in lines(tmp_path / name, "train")] for name in "13"]
    assert losses[0] == losses[1] and len(losses[0]) == 4


def test_each_process_takes_its_part(data):
    whole = source_of(data, batch_size=4)
    parts = [
        BatchQueue(source_of(data, 4), 2, lambda _: 1, World(r, 2, ALONE.device)) for r in (0, 1)
    ]
    for number in range(3):
        uids = [uid for part in parts for uid in part.take(number).uids]
        assert uids == whole.batch(number, 1).uids
    for part in parts:
        part.close()


def test_no_more_batches_are_begun_than_there_are_threads_ahead(data):
    begun = []
    source = source_of(data, batch_size=1)
    prepare = source.prepare
    source.prepare = lambda number, novel: begun.append(number) or prepare(number, novel)
    queue = BatchQueue(source, 3, lambda _: 0, ALONE, last=6)
    queue.take(0)
    queue.close()
    assert set(begun) <= {0, 1, 2, 3}
    queue = BatchQueue(source, 3, lambda _: 0, ALONE, last=6)
    begun.clear()
    for number in range(6):
        queue.take(number)
    queue.close()
    assert sorted(begun) == list(range(6)), "each once, and none behind the last"


@pytest.mark.parametrize("workers", [1, 4])
def test_an_error_is_raised_in_its_step(data, workers, monkeypatch):
    """More than half of the objects go bad one after the other: always in the same batch."""
    real = batches.load_sample
    order = [source_of(data, 1).sample(n, 0).uids[0] for n in range(5)]

    def load(dataset, index, *rest):
        if dataset.uids[index] in order[1:4]:
            raise UserError(f"{dataset.uids[index]}: spoilt")
        return real(dataset, index, *rest)

    monkeypatch.setattr(batches, "load_sample", load)
    source = source_of(data, 1)
    queue = BatchQueue(source, workers, lambda _: 0, ALONE)
    assert queue.take(0).uids == order[:1] and not source.failures
    with pytest.raises(
        UserError, match=r"^3 of 5 objects cannot be read; the last: cloud.: spoilt"
    ):
        queue.take(1)
    queue.close()


def test_a_defect_of_the_program_is_raised_in_its_step(data, monkeypatch):
    real, calls = batches.load_sample, []

    def load(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyError("defect")
        return real(*arguments)

    monkeypatch.setattr(batches, "load_sample", load)
    queue = BatchQueue(source_of(data, 2), 1, lambda _: 0, ALONE)
    queue.take(0)
    with pytest.raises(KeyError, match="defect"):
        queue.take(1)
    queue.close()


def test_closing_waits_for_one_part_of_each_thread():
    """Of a batch of 50 slow parts, only those that have begun are finished."""
    done, began = [], threading.Event()

    def slow(number):
        began.set()
        time.sleep(0.05)
        done.append(number)

    threads = Prefetcher(2)
    threads.submit("batch", [partial(slow, n) for n in range(50)], len)
    began.wait()
    threads.close()
    assert len(done) <= 4


def test_a_gpu_gets_pinned_batches(data, monkeypatch):
    """Without a GPU: what is asked of the tensors, for a device that is none."""
    asked = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda t: asked.append(t.shape) or t)
    moved = []
    to = torch.Tensor.to

    def fake(tensor, device, *rest, non_blocking=False, **options):
        if getattr(device, "type", None) != "cuda":
            return to(tensor, device, *rest, **options)
        moved.append(non_blocking)
        return tensor

    monkeypatch.setattr(torch.Tensor, "to", fake)
    queue = BatchQueue(
        source_of(data), 1, lambda _: 1, World(0, 1, torch.device("cuda", 0)), last=1
    )
    batch = queue.take(0)
    queue.close()
    tensors = (batch.inputs, batch.targets, batch.background, batch.cameras.Ks)
    assert all(tensor.shape in asked for tensor in tensors)
    assert len(asked) == len(moved) == 7 and all(moved)
    asked.clear()
    queue = BatchQueue(source_of(data), 1, lambda _: 1, ALONE, last=1)
    queue.take(0)
    queue.close()
    assert not asked, "the CPU's way is left alone"


def test_pictures_kept_on_the_device_train_as_the_files_do(data, tmp_path):
    """By another model's size than that of the targets, so that both are kept."""
    views = {"background": "random", "mirror": 0.5, "recolor": 0.5, "size": 12}
    for kept in (False, True):
        changed = {"views": {**views, "cache_device": kept}, "length": {"steps": 3}}
        assert run(data, tmp_path / str(kept), **changed) == 0
    files, device = (load_file(tmp_path / f"{k}/model.safetensors") for k in (False, True))
    assert all(torch.equal(files[name], device[name]) for name in files)


def test_kept_pictures_need_no_file_any_more(tmp_path):
    root = micro.write_dataset(tmp_path / "clouds", objects=4)
    (root / "clouda" / "002.png").write_bytes(b"no picture")
    config = micro.options(root, root, views={"cache_device": True, "size": 12})
    before = open_dataset(root, "train")
    want = before.load("cloudb", [3, 1], 12)
    kept = batches.kept_on(torch.device("cpu"), config, batches.open_data(config)).train
    for path in root.rglob("*.png"):
        path.unlink()
    got = kept.load("cloudb", [3, 1], 12)
    assert torch.equal(got.images, want.images) and got.images.dtype == torch.float32
    assert torch.equal(got.cameras.Ks, want.cameras.Ks)
    assert kept.load(1, size=micro.SIZE).images.shape == (6, 16, 16, 4)
    for views, size, reason in (([6], 12, "view 6"), ([], 12, "no views"), (None, 9, "no such")):
        with pytest.raises(UserError, match=reason):
            kept.load("cloudb", views, size)
    with pytest.raises(UserError, match="clouda/.*png"):
        kept.load("clouda", [0], 12)


def test_a_gpu_without_room_for_the_pictures_is_told(data, monkeypatch):
    config = micro.options(data, data, views={"cache_device": True})
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1000, 2000))
    monkeypatch.setattr(
        torch, "tensor", lambda *a, device=None, real=torch.tensor, **k: real(*a, **k)
    )
    with pytest.raises(UserError, match=r"^--cache-device: 30 views take 0.0 GB"):
        batches.kept_on(torch.device("cuda", 0), config, batches.open_data(config))


def test_a_small_pack_for_a_large_training_is_told(data, tmp_path):
    from gamba_warp.train.sources.pack import PackSettings, write_pack

    write_pack(data, tmp_path / "pack", PackSettings(size=8), 1)
    config = micro.options(tmp_path / "pack", tmp_path)
    assert "is packed at 8 pixels" in batches.open_data(config).notes[-1]
    write_pack(data, tmp_path / "large", PackSettings(size=16), 1)
    assert not batches.open_data(micro.options(tmp_path / "large", tmp_path)).notes
