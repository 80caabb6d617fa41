"""Batches prepared ahead: the same for any number of threads, errors in their step, a quick end."""

import threading
import time
from concurrent.futures import CancelledError
from contextlib import closing, nullcontext, suppress
from unittest.mock import DEFAULT, Mock

import pytest
import torch
from helpers import micro
from helpers.micro import ALONE, take
from helpers.refusals import refused

from gamba_warp.errors import UserError
from gamba_warp.train import batches
from gamba_warp.train.batches import Batches, open_data
from gamba_warp.train.ddp import World

GPU = torch.device("cuda", 0)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", objects=6)


def batches_of(root, batch_size=3, workers=1, world=ALONE, novel=lambda _: 0, last=None):
    views = {"background": "random", "batch_size": batch_size, "workers": workers}
    config = micro.options(root, root, views=views, run={"seed": 5})
    return Batches(open_data(config), config, world, novel, last)


def same(a, b):
    assert a.uids == b.uids
    for name in ("inputs", "targets", "background"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for name in ("cameras", "input_cameras"):
        assert torch.equal(getattr(a, name).viewmats, getattr(b, name).viewmats), name


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_the_queue_gives_the_batches_of_the_source(data, workers):
    def novel(number):
        return number % 3  # differs between batches, so that a mix-up would show

    with closing(batches_of(data, workers=workers, novel=novel, last=7)) as ahead:
        for number in range(7):
            same(ahead.take(number), take(batches_of(data, novel=novel), number))


def test_a_mirrored_sample_keeps_its_views_and_its_background(data):
    views = {"background": "random"}
    plain, turned = (
        Batches(open_data(config), config, ALONE, lambda _: 2, None)
        for config in (micro.options(data, data, views=views | {"flip": m}) for m in (0.0, 1.0))
    )
    for number in range(4):
        one, other = (take(each, number) for each in (plain, turned))
        assert one.uids == other.uids and torch.equal(one.background, other.background)
        assert torch.equal(one.targets.flip(-2), other.targets)


def test_each_process_takes_its_part(data):
    whole = batches_of(data, 4, novel=lambda _: 1)
    parts = [batches_of(data, 2, 2, World(r, 2, ALONE.device), lambda _: 1) for r in (0, 1)]
    for number in range(3):
        uids = [uid for part in parts for uid in part.take(number).uids]
        assert uids == take(whole, number).uids
    for part in parts:
        part.close()


def test_no_more_batches_are_begun_than_there_are_threads_ahead(data):
    for taken in (1, 6):
        begun, made = [], batches_of(data, 1, 3, last=6)
        prepare = made.prepare
        made.prepare = lambda number, novel: begun.append(number) or prepare(number, novel)  # noqa: B023
        for number in range(taken):
            made.take(number)
        made.close()
        assert len(begun) == len(set(begun)) and set(begun) <= set(range(taken + 3))
    assert sorted(begun) == list(range(6)), "each once, and none behind the last"


@pytest.mark.parametrize("workers", [1, 4])
def test_an_error_is_raised_in_its_step(data, workers, monkeypatch):
    """More than half of the objects fail one after the other: always in the same batch."""
    real = batches.load_sample
    order = [take(batches_of(data, 1), n).uids[0] for n in range(5)]

    def load(dataset, index, *rest):
        if dataset.uids[index] in order[1:4]:
            raise UserError(f"{dataset.uids[index]}: spoilt")
        return real(dataset, index, *rest)

    monkeypatch.setattr(batches, "load_sample", load)
    with closing(batches_of(data, 1, workers)) as made:
        assert made.take(0).uids == order[:1] and not made.failures
        refused(r"^3 of 5 objects cannot be read; the last: cloud.: spoilt", made.take, 1)


def test_a_defect_of_the_program_is_raised_in_its_step(data, monkeypatch):
    outcomes = [DEFAULT, DEFAULT, KeyError("defect"), DEFAULT]
    load = Mock(wraps=batches.load_sample, side_effect=outcomes)
    monkeypatch.setattr(batches, "load_sample", load)
    with closing(batches_of(data, 2)) as made:
        made.take(0)
        with pytest.raises(KeyError, match="defect"):
            made.take(1)


def test_closing_waits_for_one_sample_of_each_thread(data):
    """Of a batch of 50 slow samples, only the started ones are finished."""
    done, began, made = [], threading.Event(), batches_of(data, 50, 2)

    def slow(number, novel):
        began.set()
        time.sleep(0.05)
        done.append(number)

    made.prepare = slow

    def take():
        with suppress(CancelledError, RuntimeError):  # closed during the submission
            made.take(0)

    threading.Thread(target=take).start()
    began.wait()
    made.close()
    assert len(done) <= 4


class Stream:
    """A stream that writes down its events."""

    def __init__(self, name):
        self.name, self.said = name, []

    def record_event(self):
        self.said.append("recorded")
        return self

    def wait_event(self, event):
        self.said.append(f"waits for {event.name}")


def test_a_gpu_gets_pinned_batches(data, monkeypatch):
    """Without a GPU: the calls on the tensors, for a fake device."""
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
    copies, steps, kept = Stream("copies"), Stream("steps"), []
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: copies)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: steps)
    monkeypatch.setattr(torch.Tensor, "record_stream", lambda t, s: kept.append((t.shape, s)))
    with closing(batches_of(data, world=World(0, 1, GPU), novel=lambda _: 1, last=1)) as made:
        batch = made.take(0)
    tensors = (batch.inputs, batch.targets, batch.background, batch.cameras.Ks)
    assert all(tensor.shape in asked for tensor in tensors)
    assert len(asked) == len(moved) == 7 and all(moved)
    assert copies.said == ["recorded"] and steps.said == ["waits for copies"]
    assert len(kept) == 7 and {stream for _, stream in kept} == {steps}
    asked.clear()
    with closing(batches_of(data, last=1)) as made:
        made.take(0)
    assert not asked, "the CPU's way is left alone"
