"""Made objects that other processes render while a model trains: order, reuse, failures."""

import collections
import contextlib
import signal

import numpy as np
import pytest
from helpers import micro
from helpers.refusals import refused

from gamba_warp.data.dataset import ViewDataset
from gamba_warp.train.batches import Batches, open_data
from gamba_warp.train.data import pool as pools
from gamba_warp.train.data.pool import Pool
from gamba_warp.train.data.procedural import make_object
from gamba_warp.train.data.render import draw_views
from gamba_warp.train.data.settings import Settings

VIEWS = Settings(views=3, size=16, seed=3, depth=True, fronts=1, up="y")


@pytest.fixture
def slots(monkeypatch):
    monkeypatch.setattr(pools, "SLOTS", 5)
    monkeypatch.setattr(pools, "AHEAD", 2)
    monkeypatch.setattr(pools, "USES", 3)


@pytest.fixture
def in_process(monkeypatch):
    """Make objects in this process, as another takes seconds to start."""
    monkeypatch.setattr(pools, "run_each", lambda made, items, workers: enumerate(map(made, items)))
    monkeypatch.setattr(pools, "_make_views", views_of)


def views_of(number, settings):
    return draw_views(make_object(np.random.default_rng([3, number])), str(number), settings)


@pytest.fixture
def opened():
    """Pools that end with the test."""
    with contextlib.ExitStack() as stack:
        yield lambda first=0: stack.enter_context(contextlib.closing(Pool(VIEWS, first)))


def test_every_object_is_used_as_often_as_told_in_rounds_that_differ(slots):
    idle, other = object.__new__(Pool), object.__new__(Pool)
    vars(idle).update(settings=VIEWS, rank=0, world=1)
    vars(other).update(settings=VIEWS, rank=1, world=2)
    rounds = [[idle._object(5 * turn + place) for place in range(5)] for turn in range(30)]
    assert all(len({*numbers}) == 5 for numbers in rounds)
    uses = collections.Counter(number for numbers in rounds for number in numbers)
    middle = {number for numbers in rounds[5:20] for number in numbers}
    assert {uses[number] for number in middle} == {3}
    news = [len({*after} - {*before}) for before, after in zip(rounds, rounds[1:])]
    assert {1, 2} == {*news}  # 5 slots change within 3 rounds
    assert not {other._object(n) for n in range(60)} & {number * 2 for number in uses}


def test_a_pool_that_begins_later_goes_on_with_the_same_images(slots, opened, in_process):
    whole, late = opened(), opened(first=6)
    for sample in range(12):
        before = whole.take(sample)
        if sample >= 6:
            after = late.take(sample)
            assert before.uids == after.uids
            assert_same(before.load(0), after.load(0))
    assert len(whole._ready) <= 5 + 2 * 2 + pools.AHEAD  # those of older rounds are dropped


def test_other_processes_make_the_same_images(slots, opened):
    made = opened().take(0)
    number = int(made.uids[0].removeprefix("procedural-3-"))
    expected = pools._files(views_of(number, VIEWS), made.uids[0])
    ours = ViewDataset({made.uids[0]: lambda uid: expected}, "procedural", cache=False)
    assert_same(made.load(0), ours.load(0))


def assert_same(one, two):
    assert one.images.equal(two.images) and one.depths.equal(two.depths)
    assert one.backs.equal(two.backs)
    assert one.cameras.viewmats.equal(two.cameras.viewmats)
    assert one.images[..., 3].max() == 1 and one.depths.max() > 0


class Deadly:
    """Kills the process that unpickles it, before it imports anything."""

    def __reduce__(self):
        return signal.raise_signal, (signal.SIGKILL,)

    def __call__(self):
        raise NotImplementedError


def test_a_process_that_dies_is_tried_again_and_then_told(slots, opened, monkeypatch):
    monkeypatch.setattr(pools, "_make_views", Deadly())
    refused(r"procedural object \d+: its process died of signal 9", opened().take, 0)


@pytest.mark.parametrize("fraction, expected", [(0.5, 4), (0.3, 2), (1.0, 8)])
def test_a_share_of_the_samples_is_made_and_the_rest_stays(data, in_process, fraction, expected):
    def batches(made):
        views = {"procedural": made, "batch_size": 8}
        options = micro.options(data, data, views=views)
        return Batches(open_data(options), options, micro.ALONE, lambda number: 2)

    plain = batches(0.0)
    with contextlib.closing(batches(fraction)) as mixed:
        ours, theirs = micro.take(mixed, 0), micro.take(plain, 0)
    made = [uid.startswith("procedural-") for uid in ours.uids]
    assert sum(made) == expected
    assert ours.targets.shape == theirs.targets.shape
    for number, is_made in enumerate(made):
        same = ours.targets[number].equal(theirs.targets[number])
        assert same == (not is_made)
