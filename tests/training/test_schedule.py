"""Schedules at steps with known values, and after a change of the run's length."""

import itertools
from dataclasses import replace

import pytest

from gamba_warp.train.config import LossConfig, OptimConfig
from gamba_warp.train.objective.losses import Progress, radial_weight
from gamba_warp.train.optim import Schedule, ema_decay, novel_views

SHAPES = ("cosine", "trapezoid")


def steps(total, shape="cosine", warmup=10):
    return Schedule(OptimConfig(schedule=shape, warmup_steps=warmup), total, None)


def test_cosine():
    plan = steps(110)
    values = [plan.fraction(step, 0.0) for step in range(111)]
    known = [values[step] for step in (0, 9, 60, 110)]
    assert values[10] == 1.0 and known == pytest.approx([1 / 11, 10 / 11, 0.5, 0.0], abs=1e-12)
    assert all(a < b for a, b in zip(values[:10], values[1:11]))
    assert all(a > b for a, b in zip(values[10:], values[11:]))
    assert plan.fraction(200, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert steps(5, warmup=0).fraction(0, 0.0) == 1.0


def test_trapezoid():
    plan = steps(100, "trapezoid")
    values = [plan.fraction(step, 0.0) for step in range(101)]
    assert values[10:81] == [1.0] * 71
    assert values[90] == pytest.approx(0.5) and values[100] == 0.0
    assert values[0] == pytest.approx(1 / 11)


def extended(old, new, step):
    made, text = new.after(old, step, 0.0)
    return made, text, [made.fraction(i, 0.0) for i in range(step, new.total + 1)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("step", [17_000, 35_000, 39_000])
@pytest.mark.parametrize("total", [39_500, 44_000, 60_000, 400_000])
def test_no_jump_where_the_length_changes(shape, step, total):
    old, new = steps(40_000, shape, 100), steps(total, shape, 100)
    made, text, values = extended(old, new, step)
    before = old.fraction(step - 1, 0.0)
    assert abs(values[0] - before) < 0.002 and "continues from" in text
    assert max(abs(a - b) for a, b in itertools.pairwise(values)) < 0.01
    assert values[-1] == pytest.approx(0.0, abs=1e-9)
    if not made.since.rises:
        assert all(b <= a + 1e-12 for a, b in itertools.pairwise(values)), "it never rises"
    else:  # it was almost 0, and the text gives its target
        assert before < 0.1 * new.fraction(step, 0.0) and "in a tenth of the rest" in text


def test_a_run_cut_short_falls_over_what_is_left():
    """A cosine over 40,000 steps is to end at 32,000; half of the rest is half of its fall."""
    old = steps(40_000, warmup=0)
    made, _, values = extended(old, steps(32_000, warmup=0), 17_000)
    assert values[0] == pytest.approx(old.fraction(17_000, 0.0), abs=1e-12)
    assert values[7500] == pytest.approx(old.fraction(28_500, 0.0), abs=1e-9)
    assert not made.since.rises


@pytest.mark.parametrize("shape", SHAPES)
def test_a_finished_run_rises_from_nothing_to_the_schedule_of_its_new_length(shape):
    old, new = steps(1000, shape, 10), steps(2000, shape, 10)
    made, text, values = extended(old, new, 1000)
    assert values[0] < 0.02 and made.since.rises and "goes to" in text
    assert values[100:] == pytest.approx([new.fraction(i, 0.0) for i in range(1100, 2001)])


def test_a_trapezoid_that_has_not_begun_to_fall_is_lengthened_exactly():
    old, new = steps(1000, "trapezoid"), steps(3000, "trapezoid")
    values = extended(old, new, 700)[2]
    assert values == pytest.approx([new.fraction(i, 0.0) for i in range(700, 3001)], abs=1e-12)


def test_the_same_length_and_a_second_resumption_change_nothing():
    old = steps(1000)
    assert steps(1000).after(old, 300, 9.0) == (old, None)
    first, _ = steps(800).after(old, 300, 9.0)
    again, text = steps(800).after(first, 400, 12.0)
    assert again == first and text is None
    twice, _ = steps(1500).after(first, 400, 12.0)
    assert twice.fraction(400, 12.0) == pytest.approx(first.fraction(400, 12.0))
    over, text = steps(50).after(old, 300, 9.0)  # the run is over: no text
    assert text is None
    back = steps(1000).after(over, 300, 9.0)[0]
    assert back.fraction(300, 9.0) == pytest.approx(old.fraction(300, 9.0))


def test_a_change_within_the_warm_up_goes_over_to_the_new_one():
    made, _, values = extended(steps(50, warmup=100), steps(5000, warmup=100), 3)
    assert values[0] == pytest.approx(4 / 6, abs=0.01) and made.since.rises
    assert values[500] == pytest.approx(steps(5000, warmup=100).fraction(503, 0.0))


def test_minutes_go_on_without_a_jump():
    """Two steps a second, a run of 10 minutes that is resumed for 12 at 5, or for 20 at its end."""

    def by_clock(minutes):
        return Schedule(OptimConfig(warmup_steps=10), None, minutes)

    old = by_clock(10)
    made, text = by_clock(12).after(old, 600, 300.0)
    assert "12 minutes, not 10 minutes" in text
    values = [made.fraction(step, step / 2) for step in range(600, 1441)]
    assert values[0] == pytest.approx(old.fraction(600, 300.0)) and values[-1] < 1e-9
    assert all(b <= a + 1e-12 for a, b in itertools.pairwise(values))
    made, text = by_clock(20).after(old, 1200, 600.0)
    values = [made.fraction(step, step / 2) for step in range(1200, 2401)]
    assert values[0] < 0.01 and max(values) < 0.5 and values[-1] < 1e-9
    assert max(abs(a - b) for a, b in itertools.pairwise(values)) < 0.01
    in_steps = steps(2000).after(old, 600, 300.0)[0]  # from a clock to steps
    assert in_steps.fraction(600, 300.0) == pytest.approx(old.fraction(600, 300.0))


def test_novel_views_grow_from_first_to_last_in_equal_shares():
    views = [novel_views(i / 100) for i in range(101)]
    assert [views.count(n) for n in (2, 3, 4, 5, 6)] == [20, 20, 20, 20, 21]
    assert views == sorted(views)


def test_radial_weight_falls_in_epochs_or_a_share_of_the_run():
    """The paper's 10 of 400 epochs stay; of 20 epochs a quarter is 5."""
    loss = LossConfig()
    for epochs, run, want in ((0, 400, 0.1), (5, 400, 0.05), (10, 400, 0), (2.5, 20, 0.05)):
        got = radial_weight(loss, Progress(7, epochs, epochs / run))
        assert got == pytest.approx(want, abs=1e-12)
    ends = Progress(7, 5, 0.25), Progress(7, 19, 0.95)
    assert [radial_weight(loss, at) for at in ends] == [0, 0]
    assert radial_weight(replace(loss, radial_mask=False), Progress(0, 0, 0)) == 0


def test_ema_decay_is_short_at_first():
    assert ema_decay(0, 0.99) == pytest.approx(0.1)
    assert ema_decay(90, 0.99) == pytest.approx(0.91)
    assert ema_decay(10**6, 0.99) == 0.99
